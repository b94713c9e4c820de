/**
 * Plays recorded episodes, where nothing can be simulated: a robot whose simulator runs in no
 * browser, or a browser without WebGL2.
 *
 * Every subset of cameras was recorded as a whole episode on the same seed. Switching a camera off
 * goes over to the episode without it, at the same step; so the pictures jump, and the page says
 * that this is a recording. A command that no recording can obey is answered by a sentence.
 */

import {covers, intact} from './camera_state.js';
import {loadEpisode, worldAt} from './recording.js';

/** @typedef {import('./recording.js').JournalEvent} JournalEvent */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').SiteRecording} SiteRecording */
/** @typedef {import('./messages.js').World} World */
/** @typedef {import('./recording.js').Episode} Episode */

export class Player {
  /**
   * @param {string} base
   * @param {import('./messages.js').Manifest} manifest
   * @param {(answer: import('./messages.js').Answer) => void} onAnswer
   */
  constructor(base, manifest, onAnswer) {
    this.base = base;
    this.manifest = manifest;
    this.onAnswer = onAnswer;
    /** @type {SiteRecording[]} One for each side. */
    this.sides = [];
    /** @type {Record<string, import('./messages.js').CameraState>[]} */
    this.cameras = [];
    /** By side, the cameras of an episode that has ended. @type {string[]} */
    this.subsets = [];
    /** By side, what was done to cameras in this episode. @type {JournalEvent[][]} */
    this.journals = [];
    /** @type {Map<string, Promise<Episode>>} */
    this.episodes = new Map();
    /** @type {import('./messages.js').ScheduledEvent[]} */
    this.schedule = [];
    this.seed = 0;
    this.step = 0;
    this.episode = 0;
    this.number = 0;
    /** @type {'playing' | 'paused' | 'ended'} */
    this.phase = 'playing';
    /** @type {number | null} */
    this.speed = 10;
    this.autoNext = false;
    this.timer = 0;
    this.busy = Promise.resolve();
  }

  /** @param {Command} command */
  post(command) {
    this.busy = this.busy.then(() => this.obey(command)).catch(error => this.onAnswer(
      {kind: 'Problem', fatal: false, message: `A recording: ${error.message}.`}));
  }

  stop() {
    clearTimeout(this.timer);
    this.onAnswer = () => {};
  }

  /** @param {Command} command */
  async obey(command) {
    switch (command.kind) {
      case 'Open':
        this.choose([command.policy, ...(command.second ? [command.second] : [])]);
        this.schedule = command.events ?? [];
        await this.begin(command.seed);
        return this.onAnswer({kind: 'Ready', seconds: 0, backend: 'recorded', events: this.schedule});
      case 'SetSeed': return this.begin(command.seed);
      case 'Reset': return this.begin(command.next_seed ? this.nextSeed() : this.seed);
      case 'SetCamera':
        this.set(command.side, command.camera, command.state);
        return this.tell();
      case 'SetSchedule':
        this.schedule = command.events;
        return this.apply();
      case 'Play': this.phase = this.phase === 'ended' ? 'ended' : 'playing'; return this.tell();
      case 'Pause': this.phase = this.phase === 'ended' ? 'ended' : 'paused'; return this.tell();
      case 'StepOnce':
        if (this.phase !== 'ended') this.phase = 'paused';
        return this.advance();
      case 'SetSpeed': this.speed = command.rate; return undefined;
      case 'SetAutoNext': this.autoNext = command.on; return this.tell();
      case 'SetGuard': case 'SetVisible': case 'SetReadout': case 'StopRun': return undefined;
      default: throw new Error('it cannot do that; choose a policy that acts live');
    }
  }

  /** @param {string[]} policies */
  choose(policies) {
    this.sides = policies.map(name => {
      const found = this.manifest.recordings.find(one => one.policy === name);
      if (!found) throw new Error(`there is no recording of ${name}`);
      return found;
    });
    this.cameras = this.sides.map(side =>
      Object.fromEntries(side.cameras.map(camera => [camera.name, intact()])));
    this.journals = this.sides.map(() => []);
  }

  nextSeed() {
    const {seeds} = this.sides[0];
    return seeds[(seeds.indexOf(this.seed) + 1) % seeds.length];
  }

  /** @param {number} seed */
  begin(seed) {
    const {seeds} = this.sides[0];
    this.seed = seeds.includes(seed) ? seed : seeds[0];
    this.step = 0;
    this.episode += 1;
    if (this.phase === 'ended') this.phase = 'playing';
    this.cameras.forEach((cameras, index) => {
      for (const {camera, state, step} of this.schedule.filter(one => covers(one.side, index))) {
        const begins = step === 0 && state ? {input: state.input} : {};
        if (camera in cameras) cameras[camera] = {...intact(), ...begins};
      }
      this.journals[index] = Object.entries(cameras).filter(([, state]) => state.input === 'off')
        .map(([camera, state]) => ({step: 0, camera, state}));
    });
    return this.tell();
  }

  /** Failures that come by themselves at this step. */
  apply() {
    for (const event of this.schedule.filter(one => one.step === this.step)) {
      if (event.state) this.set(event.side, event.camera, event.state);
    }
    return this.tell();
  }

  /** @param {import('./messages.js').Side} side @param {string} camera
   * @param {import('./messages.js').CameraState} state */
  set(side, camera, state) {
    this.cameras.forEach((cameras, index) => {
      if (!covers(side, index) || !(camera in cameras)) return;
      const from = {before: cameras[camera], subset: subsetOf(this.sides[index], cameras)};
      cameras[camera] = {...intact(), input: state.input};
      const journal = this.journals[index];
      const same = journal.find(one => one.step === this.step && one.camera === camera);
      this.journals[index] = [...journal.filter(one => one !== same),
        {step: this.step, camera, state: cameras[camera], from: same?.from ?? from}];
    });
  }

  /** One step on. */
  advance() {
    const {horizon} = this.sides[0];
    if (this.step >= horizon) return this.tell();
    this.step += 1;
    if (this.step >= horizon) {
      this.phase = 'ended'; // How it ended stands, whatever is switched now.
      this.subsets = this.sides.map((side, index) => subsetOf(side, this.cameras[index]));
    }
    return this.apply();
  }

  /** Shows where things stand, and plans what comes. */
  async tell() {
    clearTimeout(this.timer);
    const worlds = await Promise.all(this.sides.map((side, index) => this.world(side, index)));
    this.number += 1;
    this.onAnswer({kind: 'Frame', number: this.number, phase: this.phase, speed: this.speed,
      rate: this.speed ?? 30, auto_next: this.autoNext, first: worlds[0],
      second: worlds[1] ?? null, outcomes: []});
    const wait = this.phase === 'playing' ? 1000 / (this.speed ?? 30) : 2000;
    if (this.phase === 'playing') this.later(wait, () => this.advance());
    else if (this.phase === 'ended' && this.autoNext) {
      this.later(wait, () => this.begin(this.nextSeed()));
    }
  }

  /** @param {number} wait Milliseconds. @param {() => Promise<void>} act */
  later(wait, act) {
    this.timer = window.setTimeout(() => {
      if (document.hidden) this.later(500, act);
      else this.busy = this.busy.then(act).catch(() => this.post({kind: 'Pause'}));
    }, wait);
  }

  /** @param {SiteRecording} side @param {number} index @returns {Promise<World>} */
  async world(side, index) {
    const cameras = this.cameras[index];
    const subset = this.phase === 'ended' ? this.subsets[index] : subsetOf(side, cameras);
    const key = `${this.seed}/${subset}`;
    const name = `${side.policy} ${key}`;
    const file = side.files[key];
    if (!file) throw new Error(`no episode was recorded with ${subset} on seed ${this.seed}`);
    if (!this.episodes.has(name)) {
      const loading = loadEpisode(this.base, file);
      this.episodes.set(name, loading);
      loading.catch(() => this.episodes.delete(name)); // To be tried again.
    }
    const episode = await /** @type {Promise<Episode>} */ (this.episodes.get(name));
    return worldAt(episode, side, {step: this.step, episode: this.episode, seed: this.seed,
      subset, cameras, events: this.journals[index]});
  }
}

/**
 * The name that recordings have for what is switched on.
 * @param {SiteRecording} side
 * @param {Record<string, import('./messages.js').CameraState>} cameras
 */
function subsetOf(side, cameras) {
  const on = side.cameras.filter(camera => cameras[camera.name].input !== 'off');
  if (on.length === side.cameras.length) return 'all';
  return on.map(camera => camera.name).join('+') || 'none';
}
