// Writes a box that is dragged on a camera's picture into a hidden text field (panels/patch.py).

// Pixels on the screen: a shorter drag is a click with an unsteady hand, a thinner one covers not a
// pixel of what the policy gets.
const SHORTEST = 8, THINNEST = 2;

let drag = null, count = 0;
const tileAt = (image, event) => {
  const {tile, pitch, inset, header, tiles} = Object.fromEntries(
    ['tile', 'pitch', 'inset', 'header', 'tiles'].map(name => [name, Number(image.dataset[name])]));
  const box = image.getBoundingClientRect(), scale = box.width / image.getAttribute('width');
  const index = Math.floor((event.clientX - box.left) / scale / pitch);
  const left = box.left + (index * pitch + inset) * scale, top = box.top + header * scale;
  const x = event.clientX - left, y = event.clientY - top, side = tile * scale;
  const inside = index >= 0 && index < tiles && x >= 0 && x < side && y >= 0 && y < side;
  return inside ? {image, index, left, top, side, x, y} : null;
};
const spanned = ({left, top, side, x, y}, event) => {
  const within = value => Math.min(Math.max(value, 0), side);
  const toX = within(event.clientX - left), toY = within(event.clientY - top);
  const width = Math.abs(toX - x), height = Math.abs(toY - y);
  return {left: Math.min(x, toX), top: Math.min(y, toY), width, height,
    seen: Math.max(width, height) >= SHORTEST && Math.min(width, height) >= THINNEST};
};
const tell = (image, text) => {
  const input = document.querySelector(`[data-mv-id="${image.dataset.draw}"] input`);
  if (!input) return;
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(input, text);
  input.dispatchEvent(new Event('input', {bubbles: true}));
};
const end = () => { drag?.band.remove(); drag = null; };
addEventListener('pointerdown', event => {
  end();
  const image = event.target.closest?.('img[data-draw]');
  if (!image || event.button !== 0 || event.pointerType === 'touch') return;
  const start = tileAt(image, event);
  if (!start) return;
  event.preventDefault();
  const band = document.createElement('div');
  band.className = 'mv-band';
  band.style.display = 'none';
  document.body.append(band);
  drag = {...start, band};
});
addEventListener('pointermove', event => {
  if (!drag) return;
  const {left, top, width, height, seen} = spanned(drag, event);
  Object.assign(drag.band.style, {
    display: seen ? 'block' : 'none', left: drag.left + left + 'px',
    top: drag.top + top + 'px', width: width + 'px', height: height + 'px'});
});
addEventListener('pointerup', event => {
  const done = drag;
  end();
  if (!done) return;
  const {left, top, width, height, seen} = spanned(done, event);
  if (!seen) return;
  const parts = [left + width / 2, top + height / 2, width, height].map(
    one => Math.min(Math.max(one / done.side, 0), 1).toFixed(4));
  tell(done.image, [++count, done.index, ...parts].join(' '));
});
addEventListener('pointercancel', end);
addEventListener('keydown', event => event.key === 'Escape' && end());
addEventListener('dragstart', event => {
  if (event.target.closest?.('img[data-draw]')) event.preventDefault();
});
