"""How a loaded policy of Stable-Baselines3 looks and acts here: its layout of pictures, frames that
are stacked as in training, statistics of VecNormalize, and actions that are counted before they are
clipped."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from madviz.errors import UserError
from madviz.policies.players import Reader
from madviz.subsets import camera_of
from madviz.system.depth import depth_metres
from madviz.types import Array, Encoded, EnvSpec, PolicySpec, Readout

STATE = "agent_pos"
ROUNDING = 1e-6
Observation = dict[str, Array]


@dataclass(frozen=True)
class TrainedOn:
    """The observations of training, by stream in the order of axis V."""

    keys: dict[str, str]
    """Stream -> key of the observation, ``first.depth`` -> ``first_depth``."""
    size: int
    """H and W of every picture."""
    frames: int
    """Frames that VecFrameStack put into an observation."""
    shapes: dict[str, tuple[int, ...]]
    """Key -> shape, pictures and ``agent_pos``."""


def policy_on(env: EnvSpec, policy: Any, statistics: Any, file: Path, digest: str) -> Sb3Policy:
    """``policy`` of Stable-Baselines3 from ``file``, ready to act in ``env``; ``statistics``:
    VecNormalize, or None. Raises UserError where it was trained on something else."""
    if not getattr(statistics, "norm_obs", False):
        statistics = None
    normalised = () if statistics is None else statistics.norm_obs_keys
    trained = trained_on(policy, env, normalised, str(file))
    kind = Sb3Policy if trained.frames == 1 else StackedSb3Policy
    return kind(env, policy, trained, statistics, file, digest)


def trained_on(policy: Any, env: EnvSpec, normalised: Collection[str], name: str) -> TrainedOn:
    """The observations that ``policy`` of Stable-Baselines3 was trained on; ``normalised``: keys
    that statistics are given for. Raises UserError, which begins with ``name``, where ``env`` gives
    others."""
    known = {camera.name: camera for camera in env.cameras}
    parts = dict(getattr(policy.observation_space, "spaces", {}))
    state = parts.pop(STATE, None)
    keys = {_stream(key, known): key for key in parts}
    pictures = {stream: _layout(stream, parts[key].shape) for stream, key in keys.items()}
    sizes = {layout[0] for layout in pictures.values() if layout}
    if (
        any(camera_of(stream) not in known for stream in keys)
        or None in pictures.values()
        or len(sizes) != 1
        or state is None
    ):
        raise UserError(
            f"{name}: expected pictures of {', '.join(known)} in one size and {STATE}, found "
            f"{', '.join(map(str, parts)) or 'none'}; train it on flat=True"
        )
    _check_actions(policy.action_space, env, name)
    frames = {layout[1] for layout in pictures.values() if layout}
    if len(frames) != 1:
        raise UserError(
            f"{name}: expected as many frames of each camera, found {sorted(frames)}; stack all of "
            "them with one VecFrameStack"
        )
    [count] = frames
    if state.shape != (env.state_dim * count,):
        raise UserError(
            f"{name}: expected {STATE} of {env.state_dim * count} numbers for {count} frames of "
            f"{env.task}, found {state.shape}; name the task it was trained on"
        )
    for stream, key in keys.items():
        _check_values(stream, parts[key], env, key in normalised, name)
    shapes = {key: tuple(part.shape) for key, part in (*parts.items(), (STATE, state))}
    return TrainedOn(keys, sizes.pop(), count, shapes)


def _check_actions(space: Any, env: EnvSpec, name: str) -> None:
    """Raises UserError unless the actions are those of ``env``."""
    if space.shape != (env.action_dim,):
        raise UserError(
            f"{name}: expected {env.action_dim} action numbers for {env.task}, found "
            f"{space.shape}; name the task it was trained on"
        )
    low = float(np.min(space.low))
    high = float(np.max(space.high))
    if not (np.all(space.low == -1) and np.all(space.high == 1)):
        raise UserError(
            f"{name}: expected actions from -1 to 1, found {low:g} to {high:g}; what a wrapper "
            "made of them is not in the file: train it on the task's own actions"
        )


def _check_values(stream: str, space: Any, env: EnvSpec, normalised: bool, name: str) -> None:
    """Raises UserError unless the numbers of a picture mean in training what they mean here."""
    if normalised:
        return
    if not stream.endswith(".depth"):
        if space.dtype != np.uint8:
            raise UserError(
                f"{name}: expected pictures of uint8, found {space.dtype} for {stream}; if it was "
                "trained under VecNormalize, give its statistics: sb3:FILE.zip+STATISTICS.pkl@TASK"
            )
        return
    near, far = env.camera(camera_of(stream)).depth_range
    low = float(np.min(space.low))
    high = float(np.max(space.high))
    if not np.allclose((low, high), (near, far)):
        raise UserError(
            f"{name}: expected {stream} from {near:g} to {far:g} m, found {low:g} to {high:g}; "
            "train it again on the depths that the task gives now, or with depth=False"
        )


def _layout(stream: str, shape: tuple[int, ...]) -> tuple[int, int] | None:
    """Size and number of frames of a picture, None where it is no square picture of frames."""
    if len(shape) != 3:
        return None
    rows, columns, channels = shape if _channels_last(shape) else (*shape[1:], shape[0])
    channels_of_frame = 1 if stream.endswith(".depth") else 3
    if rows != columns or channels % channels_of_frame:
        return None
    return rows, channels // channels_of_frame


def _channels_last(shape: tuple[int, ...]) -> bool:
    return shape[0] == shape[1]


def _stream(key: str, cameras: Collection[str]) -> str:
    """``first.depth`` for ``first_depth``."""
    camera = key.removesuffix("_depth")
    return f"{camera}.depth" if camera != key and camera in cameras else key


class Sb3Policy:
    """A policy that was trained on single frames. It cannot leave a camera out."""

    def __init__(
        self,
        env: EnvSpec,
        policy: Any,
        trained: TrainedOn,
        statistics: Any,
        file: Path,
        digest: str,
    ) -> None:
        """``policy`` and ``statistics`` (VecNormalize or None) as loaded, ``policy`` from ``file``.
        Raises UserError for statistics of something else."""
        self._policy = policy
        policy.set_training_mode(False)
        self._trained = trained
        self._statistics = statistics
        self._normalises_frames = statistics is not None and self._of_frames(file)
        streams = tuple(trained.keys)
        known = {camera.name: camera for camera in env.cameras}
        size = trained.size
        self._ranges = {stream: known[camera_of(stream)].depth_range for stream in streams}
        self.outside = 0
        """Action numbers so far that lay outside [-1, 1]; they are clipped."""
        self.spec = PolicySpec(
            name=file.stem,
            task=env.task,
            method=type(policy).__name__,
            setting="as trained",
            recipe="stable-baselines3",
            streams=streams,
            trained_subsets=("all",),
            frame_stack=1,
            cameras=tuple(
                replace(known[name], size=size) for name in dict.fromkeys(map(camera_of, streams))
            ),
            digest=digest,
            state_dim=env.state_dim,
            action_dim=env.action_dim,
            horizon=env.horizon,
            image_size=size,
            instruction=env.instruction,
            can_drop=False,
        )

    def encode(self, views: Array, state: Array) -> Encoded:
        """(V, 3, H, W) uint8 to one frame of what it was trained on; depth back to metres."""
        frame = {STATE: np.asarray(state, np.float32)}
        for stream, view in zip(self.spec.streams, views, strict=True):
            picture = view.transpose(1, 2, 0)  # (H, W, 3)
            if stream.endswith(".depth"):
                picture = depth_metres(picture[..., :1], self._ranges[stream])  # (H, W, 1)
            frame[self._trained.keys[stream]] = picture
        if self._normalises_frames:
            frame = self._statistics.normalize_obs(frame)
        return Encoded(np.zeros((len(views), 1), np.float32), np.asarray(state, np.float32), frame)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        """Its deterministic action after this look alone, the same for each of ``masks``, all of
        which are full."""
        action = self.action_after([encoded.private])
        rows = np.repeat(action[None], len(masks), 0)
        unknown = np.full(len(rows), np.nan, np.float32)
        return Readout(np.zeros((len(rows), 1), np.float32), rows, unknown)

    def action_after(self, frames: list[Observation]) -> Array:
        """(A,) clipped: the decision after the last ``frames`` of an episode, oldest first."""
        tensors, _ = self._policy.obs_to_tensor(self._stacked(frames))
        import torch  # Names of policies are listed without it.

        with torch.no_grad():
            action = self._policy._predict(tensors, deterministic=True).cpu().numpy()
        action = action.reshape(self.spec.action_dim)
        if self._policy.squash_output:
            action = self._policy.unscale_action(action)
        self.outside += int(np.count_nonzero(np.abs(action) > 1 + ROUNDING))
        return np.clip(np.asarray(action, np.float32), -1, 1)

    def supports(self, mask: Array) -> bool:
        return bool(np.all(mask))

    def _stacked(self, frames: list[Observation]) -> Observation:
        """The observation of training, zeros where an episode has no past yet, as VecFrameStack."""
        blank = {key: np.zeros_like(part) for key, part in frames[-1].items()}
        filled = [blank] * (self._trained.frames - len(frames)) + frames
        observation = {}
        for key, shape in self._trained.shapes.items():
            part = np.concatenate([frame[key] for frame in filled], -1)  # (H, W, CK) or (SK,)
            if len(shape) == 3 and not _channels_last(shape):
                part = part.transpose(2, 0, 1)  # (CK, H, W)
            observation[key] = part
        if self._statistics is not None and not self._normalises_frames:
            observation = self._statistics.normalize_obs(observation)
        return observation

    def _of_frames(self, file: Path) -> bool:
        """Whether the statistics are those of single frames, not of stacks. Raises UserError where
        they are of neither."""
        trained = self._trained
        found = {key: table.mean.shape for key, table in self._statistics.obs_rms.items()}
        of_one: Mapping[str, tuple[int, ...]] = {
            STATE: (trained.shapes[STATE][0] // trained.frames,),
            **{
                key: (trained.size, trained.size, 1 if stream.endswith(".depth") else 3)
                for stream, key in trained.keys.items()
            },
        }
        if all(of_one.get(key) == shape for key, shape in found.items()):
            return True
        if all(trained.shapes.get(key) == shape for key, shape in found.items()):
            return False
        key = next(key for key, shape in found.items() if trained.shapes.get(key) != shape)
        raise UserError(
            f"{file}: expected statistics of {key} with the shape {trained.shapes.get(key)}, found "
            f"{found[key]}; give the file that VecNormalize saved with this policy"
        )


class StackedSb3Policy(Sb3Policy):
    """A policy that was trained under VecFrameStack: it acts on the last frames of an episode."""

    def reset(self, seed: int) -> StackPlayer:
        """An episode begins; it has no randomness that ``seed`` would fix."""
        return StackPlayer(self, self._trained.frames)


class StackPlayer(Reader):
    """Keeps the last frames of one episode."""

    def __init__(self, policy: StackedSb3Policy, frames: int) -> None:
        super().__init__(policy)
        self._stacking = policy
        self._frames: deque[Observation] = deque(maxlen=frames)

    def act(self, encoded: Encoded, mask: Array) -> Array:
        """(A,): the decision after this look and those before it."""
        self._frames.append(encoded.private)
        return self._stacking.action_after(list(self._frames))
