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
  // Whether a tile's left edge has dashes of the frame around what is imagined (yellow).
  const imagined = (image, camera, cameras) => {
    const left = image.naturalWidth * camera / cameras, high = image.naturalHeight;
    canvas.canvas.width = 6; canvas.canvas.height = high;
    canvas.drawImage(image, left, 0, 6, high, 0, 0, 6, high);
    const pixels = canvas.getImageData(0, high / 4, 6, high / 2).data;
    for (let i = 0; i < pixels.length; i += 4)
      if (pixels[i] > 220 && pixels[i+1] > 180 && pixels[i+2] < 150) return true;
    return false;
  };
  const dropped = (...tile) => colour(...tile) < 6 || imagined(...tile);
  document.addEventListener('load', event => {
    const image = event.target;
    if (image.className !== 'mv-mosaic') return;
    const now = performance.now(), seen = status(), p = watch.pending;
    watch.steps.push([now, image.dataset.step]);
    if (p === null || seen.setting === p.setting || action() === p.action) return;
    if (dropped(image, p.camera, p.cameras) !== p.off) return;
    watch.toggles.push(performance.now() - p.start);
    watch.pending = null;
  }, true);
  watch.toggle = (camera, off) => {
    const label = off ? 'off' : 'on';
    const buttons = [...document.querySelectorAll('button')].filter(b => b.innerText === label);
    watch.pending = {camera, cameras: buttons.length, off, setting: status().setting,
                     action: action(), start: performance.now()};
    buttons[camera].click();
  };
}
