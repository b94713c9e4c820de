/**
 * The first script, so small that it runs anywhere: where the page's own cannot, it says so.
 *
 *     index.html ─► main ─► page ─► manifest.json ─► engine (worker or recordings) ─► explorer
 */

import('./page.js').then(page => page.main()).catch(error => {
  const words = document.getElementById('loading-words');
  if (words) words.textContent = `The page could not start: ${error.message}. Load it again, or try `
    + 'a newer browser.';
});
