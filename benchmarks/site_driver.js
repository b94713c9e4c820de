// Stands in for a site's page in measurements: talks to the worker, shows nothing.
globalThis.driver = (() => {
  const base = new URL('./', location.href).href;
  const worker = new Worker(new URL('worker.js', base), {type: 'module'});
  const intact = {kind: 'none', strength: 1, x: 0.5, y: 0.5, width: 0.4, height: 0.4};
  let bytes = 0, frame = null, waiting = () => {};

  worker.onmessage = ({data}) => {
    if (data.kind === 'Progress') bytes = data.done;
    if (data.kind === 'Frame') frame = data;
    waiting(data);
  };
  worker.onerror = event => waiting({kind: 'Problem', message: event.message, fatal: true});

  const post = command => worker.postMessage(command);
  const until = wanted => new Promise((resolve, reject) => {
    waiting = answer => {
      if (answer.kind === 'Problem') reject(new Error(answer.message));
      else if (wanted(answer)) resolve(answer);
    };
  });

  async function open([policy, second = null], seed) {
    const ready = until(answer => answer.kind === 'Ready');
    post({kind: 'Open', base, policy, second, seed});
    post({kind: 'Pause'});
    const {seconds, backend} = await ready;
    return {seconds, backend, bytes};
  }

  /** Decisions a second of each side, with everything on that a page shows. */
  async function rate(seconds) {
    post({kind: 'SetSpeed', rate: null});
    post({kind: 'SetAutoNext', on: true});
    post({kind: 'Play'});
    await new Promise(resolve => setTimeout(resolve, 2000));
    let decisions = 0, spent = 0, last = null;
    const end = performance.now() + 1000 * seconds;
    await until(answer => {
      if (answer.kind !== 'Frame') return false;
      const now = performance.now();
      // The pause between two episodes is no slowness.
      if (last && answer.first.episode === last.episode && answer.first.step > last.step) {
        decisions += answer.first.step - last.step;
        spent += now - last.now;
      }
      last = {episode: answer.first.episode, step: answer.first.step, now};
      return now > end;
    });
    post({kind: 'Pause'});
    return 1000 * decisions / spent;
  }

  /** A policy on the seed before the first, with those cameras alone that are present. */
  async function prepare(policy, seed, present) {
    await open([policy], seed);
    for (const camera of Object.keys(frame.first.cameras)) {
      const input = present.includes(camera) ? 'both' : 'off';
      post({kind: 'SetCamera', side: 'both', camera, state: {input, occlusion: intact}});
    }
    post({kind: 'SetReadout', every: 0});
  }

  async function play(episodes) {
    const ended = until(answer => answer.kind === 'Run' && answer.ended);
    post({kind: 'RunMany', episodes});
    return (await ended).outcomes;
  }

  async function manifest() {
    return (await fetch(new URL('manifest.json', base))).json();
  }

  async function seeds(task) {
    return (await manifest()).tasks.find(one => one.name === task).seeds;
  }

  /** Of the page's own files, which are not gzipped. */
  async function pageBytes() {
    const {page_bytes} = await manifest();
    return page_bytes;
  }

  return {open, rate, prepare, play, seeds, pageBytes};
})();
