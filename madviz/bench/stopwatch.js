() => {
  const watch = window.madviz = {steps: [], pending: null, toggles: []};
  const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const status = () => document.querySelector('.mv-status').dataset;
  const action = () => document.querySelector('.mv-action').innerText;
  // Mean distance of a tile's pixels from grey: a dropped camera's tile has none.
  const colour = (image, camera, cameras) => {
    canvas.canvas.width = 60; canvas.canvas.height = 20;
    canvas.drawImage(image, 0, 0, 60, 20);
    const wide = 60 / cameras;
    const pixels = canvas.getImageData(camera * wide + 2, 4, wide - 4, 14).data;
    let sum = 0;
    for (let i = 0; i < pixels.length; i += 4)
      sum += Math.max(pixels[i], pixels[i+1], pixels[i+2])
           - Math.min(pixels[i], pixels[i+1], pixels[i+2]);
    return sum / (pixels.length / 4);
  };
  document.addEventListener('load', event => {
    const image = event.target;
    if (image.className !== 'mv-mosaic') return;
    const now = performance.now(), seen = status(), p = watch.pending;
    watch.steps.push([now, image.dataset.step]);
    if (p === null || seen.setting === p.setting || action() === p.action) return;
    if ((colour(image, p.camera, p.cameras) < 6) !== p.off) return;
    watch.toggles.push(performance.now() - p.start);
    watch.pending = null;
  }, true);
  watch.toggle = (camera, off) => {
    const label = off ? 'off' : 'RGB';
    const buttons = [...document.querySelectorAll('button')].filter(b => b.innerText === label);
    watch.pending = {camera, cameras: buttons.length, off, setting: status().setting,
                     action: action(), start: performance.now()};
    buttons[camera].click();
  };
}
