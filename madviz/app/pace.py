"""One picture of the scene for each change, where viser would draw a dozen.

viser goes on drawing for 250 ms after every message that concerns the scene, in case something
arrives late. With a GPU nobody notices. Without one, a scene that changes four times a second is
drawn all the time, and the page is as slow as if it had stopped: what a visitor waits for shares
two cores with pictures that are all the same.

The browser asks for the time twice: when a message comes, and in the drawing loop, to see whether
250 ms have passed. So this script lets the clock run 250 ms ahead inside that loop, and nowhere
else. A message is then drawn once. Whatever really comes late, such as a decoded texture, asks for
a picture of its own; and viser draws one every second in any case. The loop is told from other
callbacks by what it does: it draws.
"""

from __future__ import annotations

PACE_SCRIPT = """
if (!window.madvizPace) {
  window.madvizPace = true;
  const AHEAD = 260;  // Milliseconds; viser's RENDER_SETTLE_MS is 250.
  const request = window.requestAnimationFrame.bind(window);
  const now = performance.now.bind(performance);
  const canvas = WebGL2RenderingContext.prototype, draw = canvas.drawElements;
  let loop = null, drew = false;
  canvas.drawElements = function (...rest) { drew = true; return draw.apply(this, rest); };
  const watched = callback => time => {
    drew = false;
    callback(time);
    if (drew && loop === null) { loop = callback; canvas.drawElements = draw; }
  };
  const paced = callback => time => {
    performance.now = () => now() + AHEAD;
    try { callback(time); } finally { delete performance.now; }
  };
  window.requestAnimationFrame = callback =>
    request(loop === null ? watched(callback) : callback === loop ? paced(callback) : callback);
}
"""
