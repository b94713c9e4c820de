// Runs at every connection: says that a page whose connection was cut has begun anew, and offers what
// was played before. VISIT names this visit where it has a simulation of its own.
const before = window.madvizVisit;
window.madvizVisit = VISIT;
if (!before || before === VISIT) return;
document.getElementById('mv-returned')?.remove();
const line = document.createElement('div');
line.id = 'mv-returned';
line.role = 'status';
line.style.cssText =
  'position:fixed;z-index:9998;left:50%;transform:translateX(-50%);bottom:12px;max-width:90vw;' +
  'padding:10px 14px;border-radius:6px;background:#fff3c4;color:#222;font:14px sans-serif;' +
  'box-shadow:0 2px 8px #0006';
const said = document.createElement('span');
said.textContent =
  'The connection was cut and has come back. The simulation began anew: its switches are as at the ' +
  'start. ';
const link = document.createElement('a');
link.href = './madviz-session?visit=' + encodeURIComponent(before);
link.download = 'madviz-session.json';
link.textContent = 'Save what you played before';
link.style.color = '#0b5394';
const close = document.createElement('button');
close.textContent = '×';
close.ariaLabel = 'Close this message';
close.style.cssText = 'margin-left:10px;border:0;color:inherit;background:none;font-size:16px;cursor:pointer';
close.onclick = () => line.remove();
line.append(said, link, close);
document.body.append(line);
