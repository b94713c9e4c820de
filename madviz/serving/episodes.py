"""A policy's answers to messages: one session for each connection.

A look holds the pictures of one step by stream, the state, and nothing of the past. Whoever sends
one frame of a camera, (H, W, 3), leaves the stack to the server; whoever sends all of them,
(H, W, 3 x frames), asks about that look alone, and gets the answer an episode in one process gives,
to the bit. A stream that is not sent, or sent as nothing (None), is dropped. A look that is refused
leaves nothing behind.

The frames of an episode, and the rest of its chunk, must not reach the next one. vla-eval says
when an episode begins and ends. openpi has no word for it, so its clients send ``episode``, a
number or text that is another one in each episode. Without it, a look is answered only where
nothing of the past counts.

A policy that learned from recordings is asked in the robot's own units: its pictures have the
cameras' aspect and get black bars here, states and actions are raw.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from madviz.envs.checks import check_action
from madviz.envs.registry import env_spec
from madviz.guard.policy import GuardedPlayer
from madviz.policies.players import player_of
from madviz.recorded.description import RecordedCamera
from madviz.recorded.films import has_bars, letterboxed
from madviz.recorded.robot import Robot
from madviz.subsets import name_of
from madviz.types import Array, Player, Policy, PolicyWithMemory, TakesPictures


class BadLook(Exception):
    """The error of a look: what was expected, and what was found."""


class ServedEpisodes:
    """The episodes of one connection, one after the other."""

    def __init__(self, policy: Policy, state_dim: int, robot: Robot | None = None) -> None:
        """``state_dim``: S of the environment it acts in. ``robot``: the robot whose recordings
        the policy learned from."""
        self._policy = policy
        self._robot = robot
        self._spec = policy.spec
        self._state_dim = state_dim
        self._action_dim = (
            len(robot.action_names)
            if robot
            else env_spec(policy.spec.task, policy.spec.render_profile).action_dim
        )
        self._boxed = False
        self._frames: dict[str, list[Array]] = {}
        self._player: Player | None = None
        self._episode: int | str | None = None
        """The name of the running episode, where a look says it."""

    def enter(self, look: dict[str, Any]) -> None:
        """Begins another episode if ``look`` of openpi says so. Raises BadLook for a look that
        needs the past and does not say which episode it belongs to."""
        episode = look.get("episode")
        if episode is not None:
            if not isinstance(episode, int | str):
                raise BadLook("expected 'episode' as a whole number or a text, found another kind")
            if episode != self._episode:
                self.begin()
            self._episode = episode
            return
        if isinstance(self._policy, PolicyWithMemory):
            raise BadLook(
                f"expected 'episode' in the look, found none, and {self._spec.name} remembers an "
                "episode; send a number that is another one in each episode"
            )
        frames = self._spec.frame_stack
        pictures = [look[stream] for stream in self._spec.streams if stream in look]
        if frames > 1 and any(_shape(picture)[2:] == (3,) for picture in pictures):
            raise BadLook(
                f"expected 'episode' beside single frames, found none, and {self._spec.name} acts "
                f"on the last {frames}; send a number that is another one in each episode, or "
                f"pictures of {frames} frames, (H, W, {3 * frames})"
            )

    def begin(self, seed: int = 0) -> None:
        """Another episode: nothing of the last one is remembered."""
        self.close()
        self._player = player_of(self._policy, seed)

    def act(self, images: Any, state: Any, boxed: bool = False) -> Array:
        """(A,) float32. ``boxed``: the client has made every picture as in training, bars and all,
        whatever a failing camera did to them then. Raises BadLook, and UserError for an action
        that is none."""
        self._boxed = boxed
        if self._player is None:
            self.begin()
        assert self._player is not None
        if not isinstance(images, dict):
            raise BadLook("expected pictures by camera, found none")
        if unknown := sorted(set(images) - set(self._spec.streams)):
            raise BadLook(
                f"expected pictures of {', '.join(self._spec.streams)}, found {unknown[0]!r:.60}; "
                "leave it out, or send it under a camera's name"
            )
        streams = self._spec.streams
        sent = {stream: images[stream] for stream in streams if images.get(stream) is not None}
        mask = np.array([stream in sent for stream in streams])
        if not self._policy.supports(mask):
            raise BadLook(f"{self._spec.name} cannot act on {name_of(mask, streams)!r}; send more")
        square = (self._spec.image_size, self._spec.image_size)
        shapes = self._policy.shapes if isinstance(self._policy, TakesPictures) else {}
        pictures = {s: self._picture(s, sent[s], shapes.get(s, square)) for s in sent}
        numbers = self._state(state)
        before = dict(self._frames)
        try:
            if isinstance(self._policy, TakesPictures):
                encoded = self._policy.encode_pictures(pictures, numbers)
            else:
                stacks = [self._stack(stream, pictures.get(stream)) for stream in streams]
                encoded = self._policy.encode(np.stack(stacks), numbers)
            action = np.asarray(self._player.act(encoded, mask), np.float32)
            check_action(action, self._action_dim)
        except Exception:
            self._frames = before  # The same look may be sent again.
            raise
        return self._robot.actions.unscale(action) if self._robot else action

    @property
    def note(self) -> str:
        """A guard's sentence on the cameras that failed at the last answer, and why; '' where none
        did."""
        if not isinstance(self._player, GuardedPlayer):
            return ""
        report = self._player.report
        whys = [f"{one}: {report.verdict(one).why}" for one in sorted(report.failed)]
        return f"{report.note} ({'; '.join(whys)})" if whys else ""

    def close(self) -> None:
        """The episode is over, or the connection is gone."""
        self._frames = {}
        player = self._player
        self._player = None
        if player is not None:
            player.close()

    def _stack(self, stream: str, picture: Array | None) -> Array:
        """(3 x frames, H, W) uint8 of a ``picture`` (H, W, C), the oldest frame first; black where
        nothing was sent. After a gap it begins anew, as an episode does."""
        size = self._spec.image_size
        frames = self._spec.frame_stack
        if picture is None:
            self._frames.pop(stream, None)
            return np.zeros((3 * frames, size, size), np.uint8)
        newest = picture.transpose(2, 0, 1)
        if len(newest) == 3 * frames:
            past = np.split(newest, frames)
        else:
            past = [*self._frames.get(stream, [newest] * (frames - 1)), newest][-frames:]
        self._frames[stream] = past
        return np.concatenate(past)

    def _picture(self, stream: str, picture: Any, wanted: tuple[int, int]) -> Array:
        """(H, W, C) uint8 in the shape ``wanted``. Raises BadLook where the aspect differs."""
        height, width = wanted
        deepest = 3 * self._spec.frame_stack
        shape = _shape(picture)
        good = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and len(shape) == 3
        if not good or shape[2] not in (3, deepest) or 0 in shape or max(shape[:2]) > 4096:
            what = f"{shape} {getattr(picture, 'dtype', type(picture).__name__)}"
            depths = "3" if deepest == 3 else f"3 or {deepest}"
            raise BadLook(
                f"expected {stream!r} as (H, W, {depths}) uint8, {height} by {width}, "
                f"found {what:.60}"
            )
        if self._robot is not None:
            camera = self._robot.camera(stream)
            made = self._boxed or has_bars(picture, camera.height, camera.width)
            if shape[:2] == wanted and made:
                return picture
            return _boxed(picture, camera, height)
        if shape[0] * width != shape[1] * height:
            other = "square" if height == width else "size of that aspect"
            raise BadLook(
                f"expected {stream!r} as {height} by {width} pixels, or another {other}, found "
                f"{shape[0]} by {shape[1]}; crop it, or give it black bars as in training"
            )
        if shape[:2] != wanted:
            frames = [
                cv2.resize(picture[..., i : i + 3], (width, height), interpolation=cv2.INTER_AREA)
                for i in range(0, shape[2], 3)
            ]
            picture = np.concatenate(frames, axis=-1)
        return picture

    def _state(self, state: Any) -> Array:
        """(S,) float32."""
        count = self._state_dim
        try:
            found = np.asarray(state, np.float32)
        except (TypeError, ValueError):
            found = np.zeros((0, 0), np.float32)
        if found.shape != (count,):
            raise BadLook(
                f"expected {count} finite numbers as the state, found {_shape(state)}; send "
                f"those of {self._spec.task}"
            )
        if not (finite := np.isfinite(found)).all():
            place = int(np.argmin(finite))
            raise BadLook(
                f"expected {count} finite numbers as the state, found {found[place]} at place "
                f"{place}; send the look again when it can be read"
            )
        return self._robot.states.scale(found) if self._robot else found


def _shape(value: Any) -> tuple[int, ...]:
    """The lengths of the axes of ``value``; of rows of unequal length, how many they are."""
    try:
        return np.shape(value)
    except ValueError:
        return (len(value),)


def _boxed(picture: Array, camera: RecordedCamera, size: int) -> Array:
    """(H, W, C) -> (size, size, C) with black bars, as in training. Raises BadLook where the aspect
    is not that of ``camera``: a picture that was squashed is another one."""
    height, width = picture.shape[:2]
    if height * camera.width != width * camera.height:
        raise BadLook(
            f"expected {camera.name!r} as {camera.height} by {camera.width} pixels, as it was "
            f"recorded, or another size of that aspect, found {height} by {width}"
        )
    frames = [letterboxed(picture[..., i : i + 3], size) for i in range(0, picture.shape[2], 3)]
    return np.concatenate(frames, axis=-1)
