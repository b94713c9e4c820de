/**
 * What a site offers: policies that act here and recordings, looked up by name and checked.
 *
 * `manifest.json` is ours, but a link's words are anybody's: a policy that is not here, a seed
 * without a start state, a camera that a task does not have. Each becomes one sentence, and the
 * rest of the link holds.
 */

import {setMeanings} from './dom.js';
import {gives} from './subsets.js';

/** @typedef {import('./messages.js').Manifest} Manifest */
/** @typedef {import('./link.js').LinkState} LinkState */
/**
 * A policy, alive or recorded.
 * @typedef {object} Entry
 * @property {string} name
 * @property {string} label
 * @property {string} task
 * @property {string} method
 * @property {string} task_label
 * @property {string} success When it is a success, in words.
 * @property {[string, string]} done What who succeeds does: `drive the nail in`, and in the past.
 * @property {number} horizon
 * @property {string[]} streams
 * @property {string[]} trained_subsets
 * @property {import('./messages.js').CameraSpec[]} cameras
 * @property {Record<string, import('./messages.js').Rate>} measured
 * @property {string} seeds_words Which seeds `measured` was counted on: `development seeds`.
 * @property {number[]} seeds
 * @property {boolean} recorded
 * @property {import('./messages.js').SiteFile} [guard] Fitted values; without them, none can watch.
 */
/** @typedef {ReturnType<Catalogue['opening']>} Opening */
/** @typedef {{policy: string, vs: string | null, seed: number,
 *   events: import('./link.js').LinkEvent[]}} Scene What is to be played. */

const STEP = 15; // A camera goes off, where the manifest does not say when.

export class Catalogue {
  /**
   * @param {Manifest} manifest
   * @param {boolean} alive Whether this browser can simulate; otherwise recordings alone count.
   */
  constructor(manifest, alive) {
    setMeanings(manifest.meanings);
    this.first = manifest.opening;
    const tasks = new Map(manifest.tasks.map(task => [task.name, task]));
    /** @type {Entry[]} */
    this.entries = [];
    for (const policy of alive ? manifest.policies : []) {
      const task = tasks.get(policy.task);
      if (!task) continue;
      this.entries.push({...policy, task_label: task.label, success: task.success,
        done: task.done, horizon: task.horizon, seeds: task.seeds, seeds_words: policy.seeds, recorded: false});
    }
    for (const one of manifest.recordings) {
      const known = this.entries.some(entry => entry.name === one.policy);
      if (known) continue; // It acts here: no need for a recording.
      this.entries.push({...one, name: one.policy, recorded: true});
    }
  }

  /** @param {string | null} name @returns {Entry | undefined} */
  find(name) {
    return this.entries.find(entry => entry.name === name);
  }

  /** @returns {{label: string, entries: Entry[]}[]} By task, in the manifest's order. */
  groups() {
    /** @type {Map<string, {label: string, entries: Entry[]}>} */
    const groups = new Map();
    for (const entry of this.entries) {
      const label = entry.recorded ? `${entry.task_label} (recorded)` : entry.task_label;
      const group = groups.get(label) ?? {label, entries: []};
      group.entries.push(entry);
      groups.set(label, group);
    }
    return [...groups.values()];
  }

  /**
   * Who can be compared with a policy: others of its task and of its kind.
   * @param {Entry} entry
   */
  rivals(entry) {
    return this.entries.filter(other => other !== entry && other.task === entry.task
      && other.recorded === entry.recorded);
  }

  /**
   * What a visitor meets first: two policies, and the camera that goes off in both. Where the
   * manifest's are not here, the first two that can be compared, or one.
   * @returns {{entries: Entry[], camera: string, step: number, seed: number}}
   */
  opening() {
    const found = [this.find(this.first?.first ?? null), this.find(this.first?.second ?? null)];
    if (this.first && found[0] && found[1] && found[0].recorded === found[1].recorded) {
      const entries = /** @type {Entry[]} */ (found), {camera, step, seed} = this.first;
      return {entries, camera, step, seed: entries[0].seeds.includes(seed) ? seed
        : entries[0].seeds[0]};
    }
    const entry = this.entries.find(one => this.rivals(one).length) ?? this.entries[0];
    const entries = [entry, ...this.rivals(entry).slice(0, 1)];
    return {entries, camera: entry.cameras[0].name, step: STEP, seed: entry.seeds[0]};
  }

  /**
   * A link's state as far as this site can play it.
   * @param {LinkState} link
   * @returns {{scene: Scene, problems: string[]}}
   */
  checked(link) {
    /** @type {string[]} */
    const problems = [];
    let entry = this.find(link.policy);
    if (!entry) {
      if (link.policy) problems.push(`The policy “${link.policy}” is not on this site.`);
      entry = this.opening().entries[0];
    }
    let vs = link.vs ? this.find(link.vs) : undefined;
    if (link.vs && !vs) problems.push(`The policy “${link.vs}” is not on this site.`);
    if (vs && (vs.task !== entry.task || vs.recorded !== entry.recorded)) {
      problems.push(`“${vs.name}” has another task than “${entry.name}”, so it is left out.`);
      vs = undefined;
    }
    let seed = link.seed ?? entry.seeds[0];
    if (!entry.seeds.includes(seed)) {
      problems.push(`Seed ${seed} has no start state here; this is seed ${entry.seeds[0]}. `
        + `Seeds here: ${entry.seeds[0]} to ${entry.seeds[entry.seeds.length - 1]}.`);
      seed = entry.seeds[0];
    }
    const known = new Set(entry.cameras.map(camera => camera.name));
    const ours = link.events.filter(one => one.guard !== undefined || known.has(one.camera));
    const strange = new Set(link.events.filter(one => !ours.includes(one)).map(one => one.camera));
    for (const name of strange) {
      problems.push(`${entry.task_label} has no camera “${name}”; it has ${[...known].join(', ')}.`);
    }
    const sides = {first: [entry], second: vs ? [vs] : [], both: vs ? [entry, vs] : [entry]};
    const blind = ours.filter(({side, camera, state}) =>
      state && sides[side].some(one => !gives(one.streams, camera, state.input)));
    for (const {camera, state} of blind) {
      problems.push(`A policy here gets no ${state?.input === 'depth' ? 'depth' : 'colour'} of `
        + `“${camera}”, so that switch is left out.`);
    }
    const late = ours.filter(one => one.step >= entry.horizon);
    for (const {camera, step} of late) {
      problems.push(`“${camera || 'guard'}” at step ${step} comes after the last decision, so that `
        + 'switch is left out.');
    }
    const alone = ours.filter(one => one.side === 'second' && !vs && !late.includes(one));
    for (const {camera, step} of alone) {
      problems.push(`“${camera || 'guard'}” at step ${step} is for side B, which is not here, so that `
        + 'switch is left out.');
    }
    let events = ours.filter(one => ![...blind, ...late, ...alone].includes(one));
    if (entry.recorded) {
      const kept = events.filter(({state}) => state && state.occlusion.kind === 'none');
      if (kept.length < events.length) {
        problems.push(`“${entry.name}” is recorded: its cameras can be off or on. Moved and broken `
          + 'cameras and the guard are left out.');
      }
      events = kept;
    }
    return {scene: {policy: entry.name, vs: vs?.name ?? null, seed, events}, problems};
  }
}
