"""One picture of the scene for each change, where viser would draw a dozen, and none in the way.

viser goes on drawing for 250 ms after every message that concerns the scene, in case something
arrives late. With a GPU nobody notices. Without one, a scene that changes four times a second is
drawn all the time, and the page is as slow as if it had stopped: what a visitor waits for shares
two cores with pictures that are all the same.

Whatever changes asks viser for a picture, and viser notes until when it shall go on:
now + 250 ms. So this script lets the clock run 250 ms late while viser takes that note, and nowhere
else. A change is then drawn once. Whatever really comes late, such as a decoded texture, asks for a
picture of its own; and viser draws one every second in any case.

viser also lets messages that concern the scene, and all that come after them, wait until the next
picture is drawn, unless the page is hidden; then it obeys them when they come. They may do so here:
those that only move or change what is there find the page hidden while they are taken in. A camera
that is switched off just then does not wait for a picture of the scene.

viser says that there is no GPU in a note that stays. All of the above is for such browsers; the
note goes ten seconds after it came, because it lies over the scene.
"""

from __future__ import annotations

PACE_SCRIPT = """
if (!window.madvizPace) {
  window.madvizPace = true;
  const SETTLES = 250;  // Milliseconds; viser's RENDER_SETTLE_MS.
  const now = performance.now.bind(performance);
  const found = setInterval(() => {
    const viser = window.__viserMutable;  // There when the scene is.
    if (!viser) return;
    clearInterval(found);
    let ask = viser.requestRender;
    const askOnce = () => {
      performance.now = () => now() - SETTLES;
      try { ask(); } finally { delete performance.now; }
    };
    Object.defineProperty(viser, 'requestRender', {get: () => askOnce, set: to => { ask = to; }});
  }, 20);
  const CHANGES = /^(GuiUpdate|SetPosition|SetOrientation|SceneNodeUpdate|SetSceneNodeVis)/;
  const workers = Worker.prototype, post = workers.postMessage;
  workers.postMessage = function (...rest) {
    if (rest[0]?.type === 'send' && this.onmessage) {
      const take = this.onmessage;
      this.onmessage = event => {
        const all = event.data?.type === 'message_batch' ? event.data.messages : [];
        const scene = all.some(one => !one.type.startsWith('Gui'));
        if (scene && all.every(one => CHANGES.test(one.type)))
          Object.defineProperty(document, 'hidden', {value: true, configurable: true});
        try { take(event); } finally { delete document.hidden; }
      };
      workers.postMessage = post;
    }
    return post.apply(this, rest);
  };
  const notes = () => [...document.querySelectorAll('.mantine-Notification-root')];
  const coming = setInterval(() => {
    const note = notes().find(one => one.innerText.startsWith('Software WebGL'));
    if (!note) return;
    clearInterval(coming);
    setTimeout(() => note.querySelector('button')?.click(), 10000);
  }, 500);
  setTimeout(() => clearInterval(coming), 60000);
}
"""
