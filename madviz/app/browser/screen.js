// Shows the pictures of a feed one at a time, each when the one before it has loaded (screen.py).

const PATIENCE = 1000;  // Milliseconds after which a picture that never loaded is given up.
const turn = image => {
  if (!image.next || performance.now() < image.busyUntil) return;
  const {src, step} = image.next.dataset;
  image.next = null;
  image.busyUntil = performance.now() + PATIENCE;
  image.dataset.step = step;
  image.src = src;
};
const take = feed => {
  const image = document.getElementById(feed.dataset.screen);
  if (!image) return;
  image.busyUntil ??= 0;
  image.onload = image.onerror = () => { image.busyUntil = 0; turn(image); };
  image.next = feed;
  turn(image);
};
new MutationObserver(records => {
  for (const record of records)
    for (const node of record.addedNodes)
      if (node.className === 'mv-feed') take(node);
}).observe(document.body, {childList: true, subtree: true});
