/**
 * The end of an episode once more with all cameras, from their first change on: the hand's path.
 *
 * A simulation of its own plays it while the page shows the end, decision by decision, so that
 * commands are obeyed in between. Up to the change it takes the episode's own actions and draws the
 * last pictures alone, those that the policy has in its stack.
 */
import {Physics} from './physics.js';
import {Simulation} from './simulation.js';

/** Steps before the change that are drawn: the pictures of a policy's stack, for the decision before
 * the change, which has to come out as it did. */
const DRAWN = 5;

export class Retrace {
  /** @param {Simulation} live One side, at the end of its episode. */
  constructor(live) {
    this.live = live;
    /** @type {Simulation | null} */
    this.twin = null;
    const switched = live.events.slice(live.started).some(event => event.guard !== undefined);
    this.done = live.changedAt === null || switched;
  }

  /** One decision; after the last one, the paths are known if the replay is exact. */
  async advance() {
    const {live} = this, since = live.changedAt ?? 0;
    const twin = this.twin ??= await this.begin();
    const action = live.actions[twin.step];
    if (twin.step === since - 1 && action.some((value, i) => value !== twin.action[i])) {
      return this.leave();
    }
    if (twin.step < since) await twin.repeat(action, twin.guard !== null || twin.step >= since - DRAWN);
    else await twin.advance();
    if (!twin.ended) return undefined;
    if (live.hands[since].every((value, axis) => value === twin.hands[since][axis])) {
      const [taken, intact] = [live, twin].map(({hands}) =>
        Float32Array.from(hands.slice(since).flat()));
      live.paths = {since, taken, intact};
    }
    return this.leave();
  }

  /** At the first step of the episode. */
  async begin() {
    const {physics, task, drawing, policy, guard, seed} = this.live;
    const own = new Physics(physics.mujoco, task.said, task.model, task.starts);
    const twin = new Simulation(task, own, drawing, policy);
    twin.watch(guard !== null);
    await twin.begin(seed, []);
    return twin;
  }

  /** Frees what the replay needed; it ends here. */
  leave() {
    this.twin?.physics.close();
    this.twin = null;
    this.done = true;
  }
}
