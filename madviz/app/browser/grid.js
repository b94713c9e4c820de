// Gives containers and cells of grids the attributes by which page.css lays them out.
//
// CSS alone could find them, with :has; but then the browser searches for every label again at
// every change of the page, and that took 47 of 75 ms of each update.

const label = (element, name, value) => {
  if (element.dataset[name] !== value) element.dataset[name] = value;
};
const layOut = marker => {
  const container = marker.parentElement.parentElement;
  label(container, 'mvGrid', marker.dataset.name);
  container.style.setProperty('--mv-columns', marker.dataset.columns);
  for (const {handle: id, column, span, label: width} of JSON.parse(marker.dataset.cells)) {
    let box = document.getElementById(id) ?? document.querySelector(`label[for="${id}"]`);
    while (box && box.parentElement !== container) box = box.parentElement;
    if (!box) continue;
    label(box, 'mvId', id);
    label(box, 'mvLabel', ['above', 'none'].includes(width) ? width : 'beside');
    box.style.setProperty('--mv-column', `${column} / span ${span}`);
    box.style.setProperty('--mv-label', width);
  }
};
const all = () => document.querySelectorAll('.mv-grid').forEach(layOut);
const matters = record => record.target.dataset?.mvGrid !== undefined
  || [...record.addedNodes].some(node => node.querySelector?.('.mv-grid'));
new MutationObserver(records => records.some(matters) && all())
  .observe(document.body, {childList: true, subtree: true});
all();
