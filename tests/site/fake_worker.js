/**
 * Stands in for the worker in tests of the page: the same commands and answers, made-up numbers.
 *
 * It has no simulator, no OpenGL and no network. A policy whose name has `merged-only` fails when a
 * camera is missing; every other one succeeds. All fail where a black one stays in the sum; a guard
 * leaves it out. Pictures are a ramp with a dot that moves.
 */

const HORIZON = 30, SIZE = 84, ACTION = 4, Z = 448;
const noOcclusion = () => ({kind: 'none', strength: 1, x: 0.5, y: 0.5, width: 0.4, height: 0.4});
const intact = () => ({input: 'both', occlusion: noOcclusion()});

let manifest, sides = [], seed = 0, step = 0, episode = 0, number = 0, speed = 10;
let phase = 'playing', autoNext = false, schedule = [], outcomes = [], timer = 0, visible = true;
let opened = false, guarded = false;

const say = answer => postMessage(answer);
const policyOf = name => manifest.policies.find(policy => policy.name === name);
const taskOf = policy => manifest.tasks.find(task => task.name === policy.task);

onmessage = async ({data}) => {
  try {
    await obey(data);
  } catch (error) {
    say({kind: 'Problem', fatal: false, message: error.message});
  }
};

async function obey(command) {
  if (command.kind === 'Open') return open(command);
  while (!opened) await new Promise(resolve => setTimeout(resolve, 5));
  const acts = {
    Play: () => { phase = 'playing'; }, Pause: () => { phase = 'paused'; },
    StepOnce: () => { phase = 'paused'; advance(); },
    SetSpeed: () => { speed = command.rate; }, SetAutoNext: () => { autoNext = command.on; },
    SetSeed: () => begin(command.seed),
    Reset: () => begin(command.next_seed ? seed + 1 : seed),
    SetGuard: () => guard(command.on),
    SetSchedule: () => { schedule = command.events; apply(); },
    SetCamera: () => set(command.side, command.camera, command.state),
    MoveCamera: () => move(command.side, command.camera, command.move),
    RunMany: () => runMany(command.episodes), StopRun: () => {},
    Save: () => say({kind: 'Saved', text: JSON.stringify({schema: 1, made_by: 'site', seed})}),
    Replay: () => { JSON.parse(command.text); throw new Error('expected a saved session'); },
    SetVisible: () => { visible = command.on; }, SetReadout: () => {},
  };
  acts[command.kind]();
  tell();
}

async function open({base, policy, second, seed: wanted, events}) {
  manifest ??= await (await fetch(new URL('manifest.json', base))).json();
  if (manifest.broken) {
    return say({kind: 'Problem', fatal: true, message: 'policy.onnx.gz is cut off.'});
  }
  for (let done = 0; done <= 10; done += 5) {
    say({kind: 'Progress', what: 'Fetching the simulator', done: done * 1e6, of: 10e6});
  }
  if (opened) await new Promise(resolve => setTimeout(resolve, 300)); // A file comes slowly.
  sides = [side(policy), ...(second ? [side(second)] : [])];
  schedule = events ?? [];
  guarded = false;
  begin(wanted);
  opened = true;
  tell(); // As stage.js does: the frame is there before it says that it is ready.
  say({kind: 'Ready', seconds: 0.1, backend: 'fake', events: schedule});
}

function side(name) {
  const policy = policyOf(name);
  return {policy, cameras: Object.fromEntries(policy.cameras.map(one => [one.name, intact()])),
    moves: {}, events: [], change: null, whole: true};
}

function begin(next) {
  [seed, step, episode] = [next, 0, episode + 1];
  if (phase === 'ended') phase = 'playing';
  const named = schedule.map(event => event.camera).filter(Boolean);
  if (named.length < schedule.length) guarded = false;
  for (const one of sides) {
    one.events = Object.entries(one.cameras).map(([camera, state]) => ({step: 0, camera, state}));
    if (guarded) one.events.push({step: 0, camera: '', guard: true});
    Object.assign(one, {change: null, whole: true});
    for (const camera of named) one.cameras[camera] = intact();
  }
  apply();
}

function meant(name) {
  return sides.filter((_, index) => name === 'both' || (name === 'first') === (index === 0));
}

function set(name, camera, state) {
  for (const one of meant(name)) {
    if (!(camera in one.cameras)) throw new Error(`unknown camera ${camera}`);
    one.change = {camera, before: one.cameras[camera], after: state, moved: false, step,
      action_change: one.policy.method === 'mad' ? 0.04 : 0.83, q_before: 12.1, q_after: 9.8};
    one.cameras[camera] = state;
    one.events = one.events.filter(event => event.step !== step || event.camera !== camera);
    one.events.push({step, camera, state});
    one.whole &&= step === 0;
  }
}

function guard(on) {
  if (on !== guarded) for (const one of sides) one.events.push({step, camera: '', guard: on});
  guarded = on;
}

function move(name, camera, to) {
  for (const one of meant(name)) {
    if (to) one.moves[camera] = to; else delete one.moves[camera];
    one.events.push({step, camera, move: to});
    one.whole &&= step === 0;
  }
}

function apply() {
  for (const event of schedule.filter(one => one.step === step)) {
    if (event.guard !== undefined) guard(event.guard);
    else if (event.state) set(event.side, event.camera, event.state);
    else move(event.side, event.camera, event.move);
  }
}

function advance() {
  if (step >= HORIZON) return;
  step += 1;
  apply();
  if (step < HORIZON) return;
  phase = 'ended';
  sides.forEach((one, index) => outcomes.push(outcome(one, index)));
}

function subset(one) {
  const on = one.policy.cameras.filter(camera => one.cameras[camera.name].input !== 'off');
  if (on.length === one.policy.cameras.length) return 'all';
  return on.map(camera => camera.name).join('+') || 'none';
}

function condition(one) {
  const failing = Object.entries(one.cameras).filter(([, state]) =>
    state.input !== 'off' && state.occlusion.kind !== 'none');
  return {subset: subset(one),
    occlusions: failing.map(([name, state]) => `${name}:${state.occlusion.kind}`).join(';'), guarded};
}

function black(one) {
  return Object.entries(one.cameras).filter(([, state]) => state.input !== 'off'
    && state.occlusion.kind === 'black').map(([camera]) => camera);
}

function succeeds(one) {
  if (black(one).length && !guarded) return false;
  return one.policy.method === 'mad' || (subset(one) === 'all' && !black(one).length);
}

function outcome(one, index) {
  return {side: index ? 'second' : 'first', policy: one.policy.name, seed, success: succeeds(one),
    success_any: succeeds(one), condition: one.whole ? condition(one) : null};
}

function runMany(episodes) {
  const found = [];
  for (let done = 1; done <= episodes; done += 1) {
    seed += 1;
    sides.forEach((one, index) => found.push({...outcome(one, index), condition: condition(one)}));
    say({kind: 'Run', done, of: episodes, ended: done === episodes, outcomes: [...found]});
  }
}

function picture(shift) {
  const rgba = new Uint8ClampedArray(SIZE * SIZE * 4);
  for (let y = 0; y < SIZE; y += 1) {
    for (let x = 0; x < SIZE; x += 1) {
      const near = Math.hypot(x - shift, y - 42) < 9 ? 200 : 0;
      rgba.set([90 + y, 70 + x + near, 60 + near, 255], 4 * (y * SIZE + x));
    }
  }
  return {width: SIZE, height: SIZE, rgba};
}

function world(one) {
  const {policy, cameras} = one;
  const views = Object.fromEntries(policy.cameras.map((camera, index) =>
    [camera.name, picture(20 + step + 10 * index)]));
  const subsets = ['all', ...policy.streams, 'none'];
  const pose = {position: [0.6, 0.2, 0.6], wxyz: [0.3, 0.9, 0.1, 0.2], fovy: 50};
  return {policy: policy.name, task: policy.task, episode, seed, step, cameras: {...cameras},
    moves: {...one.moves}, events: [...one.events], condition: condition(one),
    arrived: Object.fromEntries(policy.streams.map(stream => [stream, views[stream.split('.')[0]]])),
    poses: Object.fromEntries(policy.cameras.map(camera => [camera.name, pose])),
    geom_poses: new Float32Array(0), streams: policy.streams,
    horizon: HORIZON, mask: policy.streams.map(stream => cameras[stream].input !== 'off'
      && !(guarded && black(one).includes(stream))),
    guard: guarded ? black(one).map(camera => ({camera, kind: 'black', since: one.change.step,
      why: 'an even picture'})) : null,
    norms: Float32Array.from(policy.streams, (_, i) => 5 + i + Math.sin(step / 4 + i)),
    merged: Float32Array.from({length: Z}, (_, i) => Math.abs(Math.sin(i * 1.7 + step / 9))),
    action: Float32Array.from({length: ACTION}, (_, i) => Math.sin(step / 5 + i)), q: 12 - step / 9,
    readout: {step: step - step % 5, subsets,
      action: Float32Array.from({length: subsets.length * ACTION}, (_, i) => Math.sin(i + step / 8)),
      q: Float32Array.from(subsets, (_, i) => 12 - 2 * i)},
    success: step > 20 && succeeds(one), success_any: step > 20 && succeeds(one),
    ended: step >= HORIZON, change: one.change};
}

function tell() {
  clearTimeout(timer);
  number += 1;
  const worlds = sides.map(world);
  say({kind: 'Frame', number, phase, speed, rate: 9.4, auto_next: autoNext, first: worlds[0],
    second: worlds[1] ?? null, outcomes: [...outcomes]});
  if (phase === 'playing' && visible) {
    timer = setTimeout(() => { advance(); tell(); }, 1000 / (speed ?? 60));
  }
}
