"""Pictures and decisions of Python, with which tests compare those of a browser.

moments of an expert's episode: simulator state, pictures, what the policy makes of them
the whole episode: its actions, and whether every step was a success
"""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.envs.metaworld.environment import MetaWorld
from madviz.envs.registry import make_env
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack
from madviz.policies.checkpoint import load_policy
from madviz.subsets import every_mask
from madviz.system.depth import depth_code
from madviz.types import Array


def fixtures(name: str, seed: int, moments: int = 10) -> dict[str, Array]:
    """For the policy ``name`` in the expert's episode of ``seed``, at K evenly spaced moments:

    qpos (K, .), mocap_pos (K, 1, 3), pictures (K, V, H, W, 3), depth (K, V, H, W) as coded,
    views (K, V, 9, H, W), state (K, S), action (K, N, A) and q (K, N) for all N subsets; and for
    every step actions (T, A), success (T,), end qpos (T, .).
    """
    policy = load_policy(name)
    env = make_env(policy.spec.task, cameras=policy.spec.cameras)
    assert isinstance(env, MetaWorld)
    masks = every_mask(len(policy.spec.streams))
    stack = StreamStack(env.spec, policy.spec.streams)
    kept = set(np.linspace(0, env.spec.horizon - 1, moments).astype(int).tolist())
    rows: dict[str, list[Any]] = {}
    moment = env.reset(seed)
    for step in range(env.spec.horizon):
        views = {camera.name: env.view(camera.name) for camera in env.spec.cameras}
        stack.push(views, Ablation(), seed, step)
        if step in kept:
            encoded = policy.encode(stack.views, moment.state)
            readout = policy.read(encoded, masks)
            data = env.simulation.data
            codes = [depth_code(views[c.name].depth, c.depth_range) for c in env.spec.cameras]
            found = {
                "qpos": data.qpos,
                "mocap_pos": data.mocap_pos,
                "pictures": np.stack([views[camera.name].rgb for camera in env.spec.cameras]),
                "depth": np.stack(codes)[..., 0],
                "views": stack.views,
                "state": moment.state,
                "action": readout.action,
                "q": readout.q,
            }
            for key, value in found.items():
                rows.setdefault(key, []).append(np.array(value))
        action = env.expert().astype(np.float32)
        moment = env.step(action)
        for key, value in (
            ("actions", action), ("success", np.uint8(moment.success)),
            ("end_qpos", env.simulation.data.qpos),
        ):  # fmt: skip
            rows.setdefault(key, []).append(np.array(value))
    env.close()
    return {"masks": masks.astype(np.float32), **{k: np.stack(v) for k, v in rows.items()}}
