// On a phone, puts the scene above everything, then the opening or the tour where there is one, the
// status and the pictures. viser shows all panels there in one sheet over the scene, two thirds as
// wide as the screen, the main one first and the others closed under it.

const narrow = matchMedia('(max-width: 36em)');
const below = (root, piece) => {
  while (piece.parentElement !== root) piece = piece.parentElement;
  return piece;
};
const arrange = () => {
  const image = document.querySelector('.mv-mosaic'), status = document.querySelector('.mv-status');
  if (!narrow.matches || !image || !status) return;
  const sheet = image.closest('.mantine-Paper-root');
  if (!sheet || !sheet.contains(status)) return;
  const tour = sheet.querySelector('.mv-tour'), panels = sheet.querySelector('[data-mv-panels]');
  if (tour && panels) below(panels, tour).style.order = -3;
  if (sheet.dataset.mvPhone) return;
  let section = image, piece = status;
  while (!section.parentElement.contains(status)) section = section.parentElement;
  const root = section.parentElement;
  for (piece = piece.parentElement; piece !== root; piece = piece.parentElement)
    piece.style.display = 'contents';
  below(section, image).style.order = -1;
  section.dataset.mvPanels = '';
  section.style.display = 'contents';
  root.style.display = 'flex';
  root.style.flexDirection = 'column';
  sheet.style.width = '100%';
  sheet.style.maxHeight = '70%';
  let scene = document.querySelector('canvas');
  while (!scene.parentElement.contains(sheet)) scene = scene.parentElement;
  Object.assign(scene.style, {height: '30vh', flex: 'none', width: '100%', alignSelf: 'flex-start'});
  for (const box of sheet.querySelectorAll('div'))
    if (box.style.width === '20em') box.style.width = '100vw';
  sheet.dataset.mvPhone = 'done';
};
setInterval(arrange, 500);
arrange();
