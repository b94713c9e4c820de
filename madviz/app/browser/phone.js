// On a phone, puts the status and the pictures first. viser shows all panels there in one sheet,
// two thirds as wide as the screen, the main one first and the others closed under it.

const narrow = matchMedia('(max-width: 36em)');
const arrange = () => {
  const image = document.querySelector('.mv-mosaic'), status = document.querySelector('.mv-status');
  if (!narrow.matches || !image || !status) return;
  const sheet = image.closest('.mantine-Paper-root');
  if (!sheet || !sheet.contains(status) || sheet.dataset.mvPhone) return;
  let section = image, piece = status;
  while (!section.parentElement.contains(status)) section = section.parentElement;
  const root = section.parentElement;
  for (piece = piece.parentElement; piece !== root; piece = piece.parentElement)
    piece.style.display = 'contents';
  root.style.display = 'flex';
  root.style.flexDirection = 'column';
  section.style.order = -1;
  sheet.style.width = '100%';
  sheet.style.maxHeight = '75%';
  for (const box of sheet.querySelectorAll('div'))
    if (box.style.width === '20em') box.style.width = '100vw';
  sheet.dataset.mvPhone = 'done';
};
setInterval(arrange, 500);
arrange();
