"""``--policy sb3:model.zip``: a policy of Stable-Baselines3, which was trained on madviz's tasks.

Its file holds Python objects (cloudpickle): whoever loads it runs what is in it. So it is loaded
only when the user says that they trust it, with ``--trust`` or MADVIZ_TRUST=FILE; a name that comes
from a page or from a file is not trusted.

What it was trained on is read from its own spaces, those of ``gymnasium.make("madviz/hammer-v0",
flat=True)``: pictures by camera, ``first_depth`` in metres, and ``agent_pos``. Which task it was,
the file does not say: ``sb3:model.zip@metaworld/hammer``.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.subsets import camera_of
from madviz.types import Array, Encoded, PolicySpec, Readout

PREFIX = "sb3:"
AT = "@"
VARIABLE = "MADVIZ_TRUST"


def is_sb3(policy: str) -> bool:
    """Whether the name means a file of Stable-Baselines3."""
    return policy.startswith(PREFIX)


def trust(policy: str | None, on: bool) -> None:
    """Makes the file of ``policy`` trusted in this process and all that it starts, if ``on``."""
    if policy is not None and on and is_sb3(policy):
        os.environ[VARIABLE] = os.pathsep.join([*_trusted(), str(_parts(policy)[0].resolve())])


def shown_sb3(policy: str) -> str:
    """``policy`` as it may be shown to others: of the file's path the last part only."""
    file, task = _parts(policy)
    return f"{PREFIX}{file.name}" + (f"{AT}{task}" if task else "")


def load_sb3(policy: str) -> Sb3Policy:
    """The policy ``sb3:FILE@TASK``. Raises UserError for a file that is not trusted, cannot be
    loaded, or was trained on something else than the task's pictures and state."""
    named, task = _parts(policy)
    file = named.resolve()
    if str(file) not in _trusted():
        raise UserError(
            f"{file}: a file of Stable-Baselines3 runs code when it is loaded, and nobody has said "
            "that this one is trusted; if you trust whoever made it, add --trust"
        )
    if not task:
        raise UserError(f"expected {PREFIX}FILE{AT}TASK, found no task; add {AT}metaworld/hammer")
    try:
        from stable_baselines3.common.save_util import load_from_zip_file
    except ImportError as error:
        raise UserError(
            "expected Stable-Baselines3, found none here; pip install 'madviz[sb3]'"
        ) from error
    try:
        data, parameters, _ = load_from_zip_file(str(file), device="cpu")
        made = data["policy_class"](  # type: ignore[index]
            data["observation_space"],  # type: ignore[index]
            data["action_space"],  # type: ignore[index]
            lambda _: 0.0,
            **data.get("policy_kwargs", {}),  # type: ignore[union-attr]
        )
        made.load_state_dict(parameters["policy"])
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(
            f"{file}: expected a policy of Stable-Baselines3, found: {reason:.200}"
        ) from error
    return Sb3Policy(made, task, file)


class Sb3Policy:
    """See the module. It cannot leave a camera out."""

    def __init__(self, policy: Any, task: str, file: Path) -> None:
        """``policy``: of Stable-Baselines3, whose spaces are tables."""
        self._policy = policy
        env = env_spec(task)
        known = {camera.name: camera for camera in env.cameras}
        parts = dict(getattr(policy.observation_space, "spaces", {}))
        state = parts.pop("agent_pos", None)
        shapes = {_stream(name, known): part.shape for name, part in parts.items()}
        streams = tuple(name for name in shapes if camera_of(name) in known)
        # Pictures are trained on as (3, H, W), and depth as (H, W, 1).
        sizes = {max(shapes[name]) for name in streams if len(shapes[name]) == 3}
        if set(streams) != set(shapes) or len(sizes) != 1 or state is None:
            raise UserError(
                f"{file}: expected pictures of {', '.join(known)} in one size and agent_pos, found "
                f"{', '.join(map(str, parts)) or 'none'}; train it on flat=True"
            )
        if policy.action_space.shape != (env.action_dim,):
            raise UserError(
                f"{file}: expected {env.action_dim} action numbers for {task}, found "
                f"{policy.action_space.shape}; name the task it was trained on"
            )
        self._ranges = {name: known[camera_of(name)].depth_range for name in streams}
        size = int(sizes.pop())
        self.spec = PolicySpec(
            name=file.stem,
            task=task,
            method=type(policy).__name__,
            setting="as trained",
            recipe="stable-baselines3",
            streams=streams,
            trained_subsets=("all",),
            frame_stack=1,
            cameras=tuple(
                replace(known[name], size=size) for name in dict.fromkeys(map(camera_of, streams))
            ),
            digest=hashlib.sha256(file.read_bytes()).hexdigest(),
            state_dim=env.state_dim,
            action_dim=env.action_dim,
            horizon=env.horizon,
            image_size=size,
            instruction=env.instruction,
            can_drop=False,
        )

    def encode(self, views: Array, state: Array) -> Encoded:
        """(V, 3, H, W) uint8 to what it was trained on; depth back to metres."""
        seen: dict[str, Array] = {"agent_pos": np.asarray(state, np.float32)}
        for stream, view in zip(self.spec.streams, views, strict=True):
            if stream.endswith(".depth"):
                near, far = self._ranges[stream]
                metres = near + view[:1].astype(np.float32) / 255 * (far - near)
                seen[stream.replace(".", "_")] = metres.transpose(1, 2, 0)
            else:
                seen[stream] = view.transpose(1, 2, 0)
        return Encoded(np.zeros((len(views), 1), np.float32), seen["agent_pos"], seen)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """Its deterministic action, the same for each of ``masks``, all of which are full."""
        action, _ = self._policy.predict(encoded.private, deterministic=True)
        rows = np.repeat(np.clip(np.asarray(action, np.float32), -1, 1)[None], len(masks), 0)
        unknown = np.full(len(rows), np.nan, np.float32)
        return Readout(np.zeros((len(rows), 1), np.float32), rows, unknown)

    def supports(self, mask: Array) -> bool:
        return bool(np.all(mask))


def _stream(name: str, cameras: Collection[str]) -> str:
    """``first.depth`` for ``first_depth``."""
    camera = name.removesuffix("_depth")
    return f"{camera}.depth" if camera != name and camera in cameras else name


def _parts(policy: str) -> tuple[Path, str]:
    """File and task, '' where there is none. A folder of the file may have an @ in its name."""
    words = policy.removeprefix(PREFIX)
    file, _, task = words.rpartition(AT) if AT in words else (words, "", "")
    return Path(file), task


def _trusted() -> list[str]:
    return [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]
