/**
 * Runs in a page of a site: compares what the browser draws, reads and simulates with what Python
 * did at the same moments (`tests/site_fixtures.py`).
 */

/**
 * @param {string} task
 * @param {string} policy
 * @param {string} address Of the fixtures.
 * @param {number} seed
 */
export async function compare(task, policy, address, seed) {
  const from = name => import(new URL(name, location.href).href);
  const [{fetchGzip, fetchManifest}, {Physics, startMuJoCo}, {parseScene, shapePoses}] =
    await Promise.all(['files.js', 'physics.js', 'scene.js'].map(from));
  const [{Pictures}, {Policy, startRuntime}, {readTensors, rowOf}, {eyes}, {StreamStack}] =
    await Promise.all(['pictures.js', 'policy.js', 'tensors.js', 'cameras.js', 'streams.js'].map(from));
  const base = new URL('./', location.href).href;
  const manifest = await fetchManifest(base);
  const said = manifest.tasks.find(one => one.name === task);
  const spec = manifest.policies.find(one => one.name === policy);
  const get = file => fetchGzip(base, file);
  const runtime = {};
  for (const name of Object.keys(manifest.runtime)) {
    runtime[name] = await get(manifest.runtime[name]);
  }
  const mujoco = await startMuJoCo(runtime);
  const physics = new Physics(mujoco, said, await get(said.model), await get(said.starts));
  const scene = parseScene(await get(said.scene), await Promise.all(said.textures.map(get)));
  const gl = new OffscreenCanvas(8, 8).getContext('webgl2', {antialias: false});
  const pictures = new Pictures(gl, scene);
  const network = await Policy.load(await startRuntime(runtime), spec, await get(spec.graph));
  const {tensors} = readTensors(await (await fetch(address)).arrayBuffer());

  const [moments, cameras] = tensors.pictures.shape;
  const found = {colour: Array(cameras).fill(0), most: 0, depth_mm: Array(cameras).fill(0),
    differing: 0, action: 0, q: 0, seen_action: 0, renderer: renderer(gl)};
  const stack = new StreamStack(spec.streams);
  const masks = Array.from({length: tensors.masks.shape[0]}, (_, row) =>
    Array.from(rowOf(tensors.masks, row), Boolean));
  for (let moment = 0; moment < moments; moment++) {
    physics.begin(seed);
    physics.data.qpos.set(rowOf(tensors.qpos, moment));
    physics.data.mocap_pos.set(rowOf(tensors.mocap_pos, moment));
    mujoco.mj_forward(physics.model, physics.data);
    const drawn = pictures.views(shapePoses(scene, physics.data), eyes(spec.cameras, {}, physics), 84);
    const truth = rowOf(tensors.pictures, moment), depth = rowOf(tensors.depth, moment);
    drawn.forEach(({rgba}, camera) => {
      const pixels = rgba.length / 4, [near, far] = spec.cameras[camera].depth_range;
      for (let i = 0; i < pixels; i++) {
        const at = camera * pixels + i;
        let worst = 0;
        for (let c = 0; c < 3; c++) {
          const difference = Math.abs(rgba[4 * i + c] - truth[3 * at + c]);
          found.colour[camera] += difference / pixels / 3 / moments;
          worst = Math.max(worst, difference);
        }
        found.most = Math.max(found.most, worst);
        found.differing += worst > 0 ? 1 : 0;
        found.depth_mm[camera] +=
          Math.abs(rgba[4 * i + 3] - depth[at]) * (far - near) / 255 * 1000 / pixels / moments;
      }
    });
    // The newest picture of three is the browser's own, and the two before are Python's.
    stack.push(Object.fromEntries(spec.cameras.map((one, i) => [one.name, drawn[i]])), {},
      {seed, step: 0});
    const seen = Uint8Array.from(rowOf(tensors.views, moment)), own = stack.views();
    const size = 3 * 84 * 84;
    for (let stream = 0; stream < spec.streams.length; stream++) {
      const newest = (3 * stream + 2) * size;
      seen.set(own.subarray(newest, newest + size), newest);
    }
    const state = Float32Array.from(rowOf(tensors.state, moment));
    const read = await network.read(Uint8Array.from(rowOf(tensors.views, moment)), state, masks);
    const onSeen = await network.read(seen, state, masks);
    found.seen_action += mean(onSeen.action, rowOf(tensors.action, moment)) / moments;
    found.action = Math.max(found.action, furthest(read.action, rowOf(tensors.action, moment)));
    found.q = Math.max(found.q, furthest(read.q, rowOf(tensors.q, moment)));
  }
  return {...found, ...replay(physics, tensors, seed, rowOf)};
}

function mean(some, others) {
  return some.reduce((sum, value, i) => sum + Math.abs(value - others[i]), 0) / some.length;
}

function replay(physics, tensors, seed, rowOf) {
  physics.begin(seed);
  let [qpos, other] = [0, 0];
  const steps = tensors.actions.shape[0];
  for (let step = 0; step < steps; step++) {
    physics.act(Float32Array.from(rowOf(tensors.actions, step)));
    qpos = Math.max(qpos, furthest(physics.data.qpos, rowOf(tensors.end_qpos, step)));
    other += Number(physics.success) !== tensors.success.data[step] ? 1 : 0;
  }
  return {qpos, other_flags: other, success: physics.success,
    same_end: Number(physics.success) === tensors.success.data[steps - 1]};
}

function furthest(some, others) {
  return some.reduce((most, value, i) => Math.max(most, Math.abs(value - others[i])), 0);
}

function renderer(gl) {
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  return gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}
