"""Recorded episodes for a site: where a browser cannot simulate.

SAPIEN has no build for browsers, so ManiSkill's tasks are shown from recordings: one whole episode
for every subset of the cameras, on the same seeds, so that a page can go over from one to the other
when a camera is switched off. ``web/recording.js`` reads the files.

An episode of 50 decisions with three cameras is 153 pictures of 84 x 84; as tiles of one WebP sheet
they take 150 to 300 kB, a tenth of what they take as they are. Recording them takes a minute or two
for each policy, so what was recorded is kept, under the policy's digest, for the next site.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from safetensors.numpy import save
from scipy.spatial.transform import Rotation

from madviz.drawing.viewpoint import FOV, first_view, place_and_target
from madviz.envs.registry import make_env
from madviz.envs.tasks import done_words
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.observation.condition import Condition
from madviz.policies.checkpoint import PolicyFolder, load_policy
from madviz.session.frame import Frame, SessionPace
from madviz.session.simulation import Simulation
from madviz.site.files import SiteFile, write_packed
from madviz.subsets import every_mask, name_of
from madviz.system.files import write_bytes
from madviz.types import Array, CameraSpec, Environment, Policy

FORMAT = 1
"""The format of a recording's file; kept ones of another format are made anew."""
TILE = 84
SCENE = 240
"""Pixels, square, of the scene from outside."""
SCENE_EVERY = 2
"""The distance between steps at which the scene is drawn."""
QUALITY = 60
GROUPS = 112
"""Numbers that are kept of a merged feature: the norm of each group of its numbers."""
MOST_STREAMS = 4
"""Every subset is recorded, and each stream doubles them."""


def record_policy(
    out: Path, kept: Path, folder: PolicyFolder, described: dict[str, Any], seeds: Sequence[int]
) -> dict[str, Any]:
    """Records every subset of a policy's cameras on ``seeds``; its line of the manifest. What is in
    the folder ``kept`` already is taken from there. ``described``: its name, label, cameras and
    measured success. Raises UserError for too many streams."""
    spec = folder.spec
    if len(spec.streams) > MOST_STREAMS:
        raise UserError(
            f"expected at most {MOST_STREAMS} streams to record every subset of, found "
            f"{len(spec.streams)} of {spec.name}; leave it out of --policies"
        )
    files: dict[str, SiteFile] = {}
    policy = load_policy(folder.path)
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env, one_thread():
        for seed in seeds:
            for mask in every_mask(len(spec.streams)):
                subset = name_of(mask, spec.streams)
                before = kept / f"{FORMAT}-{spec.digest[:16]}-{seed}-{subset}"
                if not before.is_file():
                    before.parent.mkdir(parents=True, exist_ok=True)
                    write_bytes(before, record_episode(env, policy, mask, seed))
                name = f"recordings/{spec.name}/{seed}-{subset}.gz"
                files[f"{seed}/{subset}"] = write_packed(out, name, before.read_bytes())
        task = env.spec
    shown = ("label", "method", "task", "streams", "trained_subsets", "cameras", "measured")
    return {
        **{name: described[name] for name in shown},
        "policy": spec.name,
        "task_label": task.task.partition("/")[2].replace("-", " ").capitalize(),
        "success": task.success,
        "done": done_words(task.task),
        "horizon": task.horizon,
        "seeds_words": described["seeds"],
        "seeds": list(seeds),
        "files": files,
    }


def record_episode(env: Environment, policy: Policy, mask: Array, seed: int) -> bytes:
    """The file of one episode under the subset ``mask`` (V,) bool."""
    streams = policy.spec.streams
    simulation = Simulation(env, policy, Condition(name_of(mask, streams)).ablation(streams))
    simulation.begin(seed)
    outside = viewpoint_of(simulation, env.spec.cameras[-1])
    tiles: list[Array] = []
    scenes: list[Array] = []
    rows: dict[str, list[Array]] = {}
    for step in range(env.spec.horizon + 1):
        if step:
            simulation.step(lambda: None)
        tiles += [picture_of(simulation.arrived[stream]) for stream in streams]
        if step % SCENE_EVERY == 0:
            scenes.append(scene_of(env, outside))
        for name, row in numbers_of(simulation, mask).items():
            rows.setdefault(name, []).append(row)
    masks = simulation.probe.masks
    metadata = {
        "tile": str(TILE),
        "scene_width": str(SCENE),
        "scene_height": str(SCENE),
        "scene_every": str(SCENE_EVERY),
        "subsets": json.dumps([name_of(other, streams) for other in masks]),
    }
    arrays = {name: np.stack(values) for name, values in rows.items()}
    arrays |= {"sheet": sheet(tiles), "scene": sheet(scenes)}
    return save(arrays, metadata)


def numbers_of(simulation: Simulation, mask: Array) -> dict[str, Array]:
    """The numbers that a page shows of one time step, beside pictures."""
    probe = simulation.probe
    row = simulation.probe.row(mask)
    return {
        "norms": probe.norms.astype(np.float32),
        "merged": grouped(probe.merged(row)),
        "action": probe.readout.action[row].astype(np.float32),
        "q": np.asarray(probe.readout.q[row], np.float32),
        "readout_action": probe.readout.action.astype(np.float32),
        "readout_q": probe.readout.q.astype(np.float32),
        "success": np.asarray(simulation.now.time.success, np.uint8),
    }


def grouped(merged: Array) -> Array:
    """(G,) float32 norms of groups of the numbers of ``merged`` (Z,), whose norm stays."""
    starts = np.linspace(0, len(merged), min(GROUPS, len(merged)), endpoint=False).astype(int)
    return np.sqrt(np.add.reduceat(merged.astype(np.float32) ** 2, starts))


def picture_of(arrived: Array) -> Array:
    """(TILE TILE 3) uint8 of what reached the policy (H W C)."""
    picture = np.repeat(arrived, 3, axis=2) if arrived.shape[2] == 1 else arrived
    if picture.shape[:2] != (TILE, TILE):
        return np.asarray(Image.fromarray(picture).resize((TILE, TILE)))
    return picture


def viewpoint_of(simulation: Simulation, camera: CameraSpec) -> CameraSpec:
    """``camera`` where everything that matters is in its sight, as the page's scene begins."""
    pace = SessionPace(0, "paused", None, float("nan"), False)
    points, ahead = first_view(Frame(simulation.world(), pace))
    place, target = place_and_target(points, ahead, 1.0)
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    w, x, y, z = Rotation.from_matrix(axes).as_quat(scalar_first=True).tolist()
    px, py, pz = place.tolist()
    return CameraSpec(
        name=camera.name,
        label=camera.label,
        fovy=float(np.degrees(FOV)),
        position=(px, py, pz),
        wxyz=(w, x, y, z),
    )


def scene_of(env: Environment, outside: CameraSpec) -> Array:
    """(SCENE SCENE 3) uint8: the scene from ``outside``. A camera is lent for it, and put back."""
    env.move_camera(outside.name, outside)
    try:
        return env.view(outside.name, SCENE).rgb
    finally:
        env.move_camera(outside.name, None)


def sheet(tiles: Iterable[Array]) -> Array:
    """(n,) uint8: a WebP picture with all tiles (S S 3), row by row, as square as it can be."""
    stacked = np.stack(list(tiles))
    count = len(stacked)
    size = stacked.shape[1]
    columns = int(np.ceil(np.sqrt(count)))
    rows = int(np.ceil(count / columns))
    whole = np.zeros((rows * columns, size, size, 3), np.uint8)
    whole[:count] = stacked
    picture = whole.reshape(rows, columns, size, size, 3).swapaxes(1, 2)
    buffer = io.BytesIO()
    image = Image.fromarray(picture.reshape(rows * size, columns * size, 3))
    image.save(buffer, "WEBP", quality=QUALITY, method=4)
    return np.frombuffer(buffer.getvalue(), np.uint8)
