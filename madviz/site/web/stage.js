/**
 * What the worker does: the loop, and the commands.
 *
 * The loop obeys all commands that have come, takes a decision if one is due, and shows it. A
 * command is never in the middle of a decision, so a switch counts from the next one on.
 */
import {Episodes, MOST_SAVED} from './episodes.js';
import {readEpisode, savedEpisode, savedSession} from './saved.js';
import {Simulation} from './simulation.js';
import {Stock} from './stock.js';

/** @typedef {import('./messages.js').Answer} Answer */
/** @typedef {import('./messages.js').Command} Command */
/** @typedef {import('./messages.js').ScheduledEvent} ScheduledEvent */
/** @typedef {import('./messages.js').Side} Side */

/** Milliseconds for which the end of an episode stays, and where there are words to read: a camera
 * was changed, or policies were compared. */
const HOLD = 2000;
const HOLD_TO_READ = 10000;
const OF_CAMERAS = ['SetCamera', 'MoveCamera'];

export class Stage extends Episodes {
  /** @param {(answer: Answer, buffers?: Transferable[]) => void} say */
  constructor(say) {
    super(say);
    /** @type {Command[]} */
    this.queue = [];
    /** @type {Stock | null} */
    this.stock = null;
    this.visible = true;
  }

  /** @param {Command} command */
  send(command) {
    this.queue.push(command);
    this.pace.wake();
  }

  /** The loop; it never ends. */
  async run() {
    for (;;) {
      try {
        await this.turn();
      } catch (error) {
        if (this.phase !== 'ended') this.phase = 'paused';
        this.stopMany();
        this.problem(error);
        if (this.sides.every(one => one.begun)) this.show();
      }
    }
  }

  async turn() {
    const command = this.queue.shift();
    if (command) return this.overtaken(command) || this.obey(command);
    if (this.sides.length === 0 || !this.visible) return this.pace.sleep();
    if (this.many) return this.playMany();
    if (this.phase === 'ended') {
      const changed = this.sides[0].events.some(event => event.guard === undefined);
      const toRead = this.sides.length > 1 || changed;
      const left = this.endedAt + (toRead ? HOLD_TO_READ : HOLD) - performance.now();
      if (left <= 0 && this.autoNext) {
        this.phase = 'playing';
        return this.begin(this.nextSeed());
      }
      return await this.retrace() || this.pace.sleep(this.autoNext ? left : undefined);
    }
    if (this.phase !== 'playing') return this.pace.sleep();
    if (await this.pace.due()) await this.step();
  }

  /**
   * Whether a later command of the same kind for the same camera already waits: a slider that is
   * dragged sends more than can be drawn.
   * @param {any} command
   */
  overtaken(command) {
    const end = this.queue.findIndex(one => !OF_CAMERAS.includes(one.kind));
    const newer = end < 0 ? this.queue : this.queue.slice(0, end);
    return OF_CAMERAS.includes(command.kind) && newer.some((/** @type {any} */ one) =>
      one.kind === command.kind && one.camera === command.camera && one.side === command.side);
  }

  /** @param {Command} command */
  async obey(command) {
    if (command.kind === 'Open') return this.open(command);
    if (this.sides.length === 0) return;
    const act = /** @type {any} */ (this)[`on${command.kind}`];
    if (!act) throw new Error(`expected a command, found ${String(command.kind).slice(0, 40)}`);
    await act.call(this, command);
    if (!['Save', 'SetVisible', 'RunMany'].includes(command.kind)) this.show();
  }

  // --- Commands -----------------------------------------------------------------------------------

  /** @param {import('./messages.js').Open} command */
  async open({base, policy, second, seed, events}) {
    const start = performance.now();
    const first = this.sides.length === 0;
    try {
      this.stock ??= await Stock.open(base, this.say);
      const names = [policy, ...(second ? [second] : [])];
      const sides = await this.made(names);
      sides.forEach(side => side.physics.check(seed));
      this.stopMany();
      this.guarded = false;
      this.replace(sides);
      this.schedule = events ?? [];
      this.phase = 'playing';
      await this.begin(seed);
      this.ready(start);
    } catch (error) {
      this.problem(error, first);
    }
  }

  /** @param {import('./messages.js').SetCamera} command */
  async onSetCamera({side, camera, state}) {
    for (const one of this.meant(side)) await one.set({camera, state});
    await this.readAll();
  }

  /** @param {import('./messages.js').MoveCamera} command */
  async onMoveCamera({side, camera, move}) {
    for (const one of this.meant(side)) await one.set({camera, move});
    await this.readAll();
  }

  /** @param {{seed: number}} command */
  onSetSeed({seed}) {
    this.sides[0].physics.check(seed);
    this.stopMany();
    return this.begin(seed);
  }

  /** @param {{next_seed: boolean}} command */
  onReset({next_seed}) {
    return this.begin(next_seed ? this.nextSeed() : this.seed);
  }

  async onPlay() {
    if (this.phase === 'ended') await this.begin(this.seed);
    this.phase = 'playing';
  }

  onPause() {
    if (this.phase !== 'ended') this.phase = 'paused';
  }

  async onStepOnce() {
    if (this.phase === 'ended') return;
    await this.step(false);
    if (this.phase !== 'ended') this.phase = 'paused';
  }

  /** @param {{rate: number | null}} command */
  onSetSpeed({rate}) {
    this.pace.rate = rate;
  }

  /** @param {{on: boolean}} command */
  onSetAutoNext({on}) {
    this.autoNext = on;
  }

  /** @param {{on: boolean}} command */
  async onSetGuard({on}) {
    this.guarded = on;
    this.schedule = this.schedule.filter(one => one.guard === undefined); // This is newer.
    for (const one of this.sides) await one.setGuard(on);
    await this.readAll();
  }

  /** @param {{events: ScheduledEvent[]}} command */
  async onSetSchedule({events}) {
    this.schedule = events;
    if (this.sides[0].step === 0) await this.begin(this.seed);
  }

  /** @param {{every: number}} command */
  async onSetReadout({every}) {
    this.readEvery = every;
    await this.readAll();
  }

  /** @param {{episodes: number}} command */
  async onRunMany({episodes}) {
    this.many = {done: 0, of: episodes, outcomes: [], shown: 0};
    await this.begin(this.nextSeed());
  }

  onStopRun() {
    if (this.many) this.endMany();
  }

  async onSave() {
    const now = this.sides[0];
    const current = now.actions.length > 0 && !now.ended ? [await savedEpisode(now)] : [];
    const episodes = [...this.episodes, ...current].slice(-MOST_SAVED);
    if (episodes.length === 0) throw new Error('Nothing has been played yet that could be saved.');
    const versions = this.stock?.manifest.versions ?? {};
    this.say({kind: 'Saved', text: savedSession(episodes, versions)});
  }

  /** @param {{text: string, episode?: number}} command */
  async onReplay({text, episode}) {
    const start = performance.now();
    const recipe = readEpisode(text, episode, this.stock?.manifest.policies ?? []);
    const sides = await this.made([recipe.policy]);
    sides[0].physics.check(recipe.seed);
    this.stopMany();
    this.guarded = false;
    this.replace(sides);
    this.schedule = recipe.events.map(event => ({...event, side: /** @type {Side} */ ('both')}));
    this.phase = 'playing';
    await this.begin(recipe.seed);
    this.ready(start);
  }

  /** @param {{on: boolean}} command */
  onSetVisible({on}) {
    this.visible = on;
    this.pace.restart();
  }

  // --- Parts --------------------------------------------------------------------------------------

  /** @param {number} start When what is played now was asked for. */
  ready(start) {
    const seconds = (performance.now() - start) / 1000;
    this.say({kind: 'Ready', seconds, backend: this.drawing.backend, events: this.schedule});
  }

  /**
   * Simulations of policies of one task, ready to begin.
   * @param {string[]} names
   */
  async made(names) {
    const stock = /** @type {Stock} */ (this.stock);
    names.forEach(name => stock.describe(name));
    return Promise.all(names.map(async name => {
      const [task, policy] = await Promise.all(
        [stock.task(stock.describe(name).task), stock.policy(name)]);
      const physics = await stock.physics(task);
      return new Simulation(task, physics, this.drawing, policy);
    }));
  }

  /** @param {Simulation[]} sides */
  replace(sides) {
    for (const old of this.sides) old.physics.close();
    this.sides = sides;
    for (const one of sides) one.watch(this.guarded);
  }

  /** @param {Side} side */
  meant(side) {
    return side === 'both' ? this.sides : this.sides.slice(...(side === 'first' ? [0, 1] : [1, 2]));
  }
}
