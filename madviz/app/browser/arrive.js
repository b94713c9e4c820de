// Runs before viser's client: which address its websocket has, why it does not open, and how wide the
// window is. viser tells the server the width of its canvas in the screen's pixels, and the layout is
// chosen by it. So a pixel of the screen counts as one of the page until the layout is there.
(() => {
  const {get} = Object.getOwnPropertyDescriptor(window, 'devicePixelRatio');
  Object.defineProperty(window, 'devicePixelRatio',
    {configurable: true, get: () => window.madvizRan ? get.call(window) : 1});
  const address = new URL(location.href);
  address.searchParams.delete('entered');
  if (address.pathname.endsWith('/') && address.pathname !== '/' && location.protocol !== 'about:') {
    const socket = new URL(address.pathname, location.href);
    socket.protocol = location.protocol === 'https:' ? 'wss:' : 'ws:';
    address.searchParams.set('websocket', socket.href);
  }
  if (address.href !== location.href) history.replaceState(null, '', address);

  const UPGRADE =
    'No websocket of this page comes through. Let the proxy before it pass websockets on (nginx: ' +
    'proxy_http_version 1.1; proxy_set_header Upgrade $http_upgrade; proxy_set_header Connection ' +
    '"upgrade";).';
  const line = document.createElement('div');
  line.id = 'mv-arrival';
  line.style.cssText =
    'position:fixed;z-index:9999;left:0;right:0;bottom:0;padding:12px 16px;background:#fff3c4;' +
    'color:#222;font:15px sans-serif;overflow-wrap:anywhere';

  let seconds = 0;
  const timer = setInterval(async () => {
    if (window.madvizRan) {
      clearInterval(timer);
      line.remove();
      return;
    }
    seconds += 1;
    if (seconds % 5) return;
    try {
      const asked = './madviz-arrival?origin=' + encodeURIComponent(location.origin);
      const answer = await fetch(asked, { cache: 'no-store' });
      if (!answer.ok || window.madvizRan) return;
      const said = (await answer.text()) || (seconds >= 15 ? UPGRADE : '');
      line.textContent = said;
      if (said) document.body.append(line);
    } catch {
      // Nobody answers: viser says that it connects, and that is all there is to say.
    }
  }, 1000);
})();
