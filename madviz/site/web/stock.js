/**
 * What was fetched, once each: programs, tasks, policies. And how much of it has come so far.
 */
import {fetchGzip, fetchManifest} from './files.js';
import {Physics, startMuJoCo} from './physics.js';
import {Policy, startRuntime} from './policy.js';
import {parseScene} from './scene.js';

/** @typedef {import('./messages.js').Manifest} Manifest */
/** @typedef {import('./messages.js').SiteFile} SiteFile */
/** @typedef {import('./messages.js').SiteTask} SiteTask */
/** @typedef {import('./messages.js').SitePolicy} SitePolicy */
/** @typedef {import('./messages.js').Answer} Answer */
/**
 * @typedef {object} Task
 * @property {SiteTask} said
 * @property {ArrayBuffer} model
 * @property {ArrayBuffer} starts
 * @property {import('./scene.js').Scene} scene
 */
/** @typedef {'mujoco.js' | 'mujoco.wasm' | 'ort.js' | 'ort_glue.js' | 'ort.wasm'} Program */

/** @type {Program[]} */
const MUJOCO = ['mujoco.js', 'mujoco.wasm'];
/** @type {Program[]} */
const ORT = ['ort.js', 'ort_glue.js', 'ort.wasm'];

export class Stock {
  /**
   * @param {string} base
   * @param {Manifest} manifest
   * @param {(answer: Answer, buffers?: Transferable[]) => void} say
   */
  constructor(base, manifest, say) {
    this.base = base;
    this.manifest = manifest;
    this.say = say;
    this.wanted = 0;
    this.come = 0;
    /** By what they hold. @type {Map<string, Promise<any>>} */
    this.kept = new Map();
  }

  /**
   * @param {string} base
   * @param {(answer: Answer, buffers?: Transferable[]) => void} say
   */
  static async open(base, say) {
    return new Stock(base, await fetchManifest(base), say);
  }

  /**
   * The policy's line of the manifest. Throws an Error for a name that is not there.
   * @param {string} name
   */
  describe(name) {
    const found = this.manifest.policies.find(policy => policy.name === name);
    if (!found) throw new Error(`This site has no policy ${name.slice(0, 80)}.`);
    return found;
  }

  /** @param {string} name @returns {Promise<Policy>} */
  policy(name) {
    const spec = this.describe(name);
    return this.once(`policy ${name}`, async () => {
      const runtime = this.runtime();
      const [graph, guard] = await Promise.all([this.file(spec.graph),
        spec.guard ? this.file(spec.guard) : undefined]);
      return Policy.load(await runtime, spec, graph, guard);
    });
  }

  /** @param {string} name @returns {Promise<Task>} */
  task(name) {
    const said = this.manifest.tasks.find(task => task.name === name);
    if (!said) throw new Error(`This site has no task ${name}.`);
    return this.once(`task ${name}`, async () => {
      const files = [said.model, said.starts, said.scene, ...said.textures];
      const [model, starts, buffer, ...textures] =
        await Promise.all(files.map(file => this.file(file)));
      const scene = parseScene(buffer, textures.map(one => one.slice(0)));
      this.say({kind: 'Scene', task: name, buffer, textures}, [buffer, ...textures]);
      return {said, model, starts, scene};
    });
  }

  /** A simulation of a task, of its own. @param {Task} task */
  async physics(task) {
    return new Physics(await this.mujoco(), task.said, task.model, task.starts);
  }

  mujoco() {
    return this.once('mujoco', async () => startMuJoCo(await this.programs(MUJOCO)));
  }

  runtime() {
    return this.once('runtime', async () => startRuntime(await this.programs(ORT)));
  }

  /** @param {Program[]} names @returns {Promise<any>} */
  async programs(names) {
    const files = await Promise.all(names.map(name => this.file(this.manifest.runtime[name])));
    return Object.fromEntries(names.map((name, i) => [name, files[i]]));
  }

  /** @param {SiteFile} file */
  file(file) {
    this.wanted += file.bytes;
    const what = file.path.split('/')[0];
    return fetchGzip(this.base, file, bytes => {
      this.come += bytes;
      this.say({kind: 'Progress', what, done: this.come, of: this.wanted});
    });
  }

  /**
   * What failed is tried again the next time.
   * @template T
   * @param {string} key
   * @param {() => Promise<T>} make
   * @returns {Promise<T>}
   */
  once(key, make) {
    let found = this.kept.get(key);
    if (!found) {
      found = make();
      this.kept.set(key, found);
      found.catch(() => this.kept.delete(key));
    }
    return found;
  }
}
