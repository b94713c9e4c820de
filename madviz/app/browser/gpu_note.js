// Where there is no GPU, viser says so in a note that lies over the scene. The same is said here in
// a line at the scene's foot, and the note is closed.

const notes = () => [...document.querySelectorAll('.mantine-Notification-root')];
const coming = setInterval(() => {
  const note = notes().find(one => one.innerText.startsWith('Software WebGL'));
  if (!note) return;
  clearInterval(coming);
  const line = document.createElement('div');
  line.className = 'mv-gpu';
  line.textContent = 'no GPU: the scene is drawn in software';
  line.title = note.innerText;
  document.body.append(line);
  note.style.visibility = 'hidden';
  note.querySelector('button')?.click();
}, 200);
setTimeout(() => clearInterval(coming), 60000);
