// Closes viser's note that there is no GPU ten seconds after it came: it lies over the scene.

const notes = () => [...document.querySelectorAll('.mantine-Notification-root')];
const coming = setInterval(() => {
  const note = notes().find(one => one.innerText.startsWith('Software WebGL'));
  if (!note) return;
  clearInterval(coming);
  setTimeout(() => note.querySelector('button')?.click(), 10000);
}, 500);
setTimeout(() => clearInterval(coming), 60000);
