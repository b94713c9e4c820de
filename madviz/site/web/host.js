/**
 * Says why the page's program did not start. No module, so that it runs where modules do not: a
 * browser runs a module only from a host that calls it JavaScript.
 */
addEventListener('error', event => {
  const line = document.getElementById('loading-words');
  if (event.target instanceof HTMLScriptElement && line) {
    line.textContent = 'The program of this page did not start: a file is missing, or this host does '
      + 'not serve .js files as text/javascript, which browsers insist on.';
  }
}, true);
