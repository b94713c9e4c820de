// Draws the scene once for each change, where viser would draw a dozen times (viser_patches.py).

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
