"""robot.json of a policy folder: what a policy that learned from recordings needs at the robot.

    {"schema": 1, "fps": 30.0,
     "cameras": [{"key": "observation.images.top", "name": "top", "height": 480, "width": 640}],
     "state": {"names": ["shoulder", ...], "low": [...], "high": [...]},
     "action": {"names": [...], "low": [...], "high": [...], "spread": [...]},
     "held_out": [9, 19],
     "trained_on": ["5e0c…", ...]}

The policy itself reads and says numbers between -1 and 1; ``Robot`` has both scalings. Episodes
that it learned from are known by a digest of their numbers, in whatever dataset they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from madviz.errors import UserError
from madviz.recorded.description import RecordedCamera
from madviz.recorded.scaling import Scaling, apart
from madviz.system.files import read_json, write_json
from madviz.system.typed import typed
from madviz.types import Array

if TYPE_CHECKING:
    from madviz.recorded.recordings import Recordings  # Its libraries take 0.4 s to load.

FILE = "robot.json"
FIX = "restore the file or train the policy again"


class _Numbers(msgspec.Struct):
    names: list[str]
    low: list[float]
    high: list[float]
    spread: list[float] = []


class _File(msgspec.Struct):
    schema: int
    fps: float
    cameras: list[RecordedCamera]
    state: _Numbers
    action: _Numbers
    held_out: list[int]
    trained_on: list[str] = []  # Older files have none.


@dataclass(frozen=True)
class Robot:
    """The facts of a robot that its recordings tell."""

    cameras: tuple[RecordedCamera, ...]
    """``kind`` is not kept, and has its default."""
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    states: Scaling
    actions: Scaling
    spread: tuple[float, ...]
    """(A,) standard deviation of the actions in training, raw units; 1 where it is 0."""
    fps: float
    held_out: tuple[int, ...]
    """The episodes that were kept from training, by their index there."""
    trained_on: frozenset[str] = frozenset()
    """The others, by ``Recordings.digest``; empty for a policy of which that is not known."""

    def camera(self, name: str) -> RecordedCamera:
        """The camera called ``name``, which must be there."""
        return next(camera for camera in self.cameras if camera.name == name)

    def learned_from(self, recordings: Recordings, episode: int) -> bool:
        """True where the policy was trained on this episode."""
        return recordings.digest(episode) in self.trained_on

    def unseen(self, recordings: Recordings) -> tuple[int, ...]:
        """The indices of the episodes that the policy was not trained on; where that is not known,
        of those with the numbers that were held out."""
        known = (one.index for one in recordings.episodes)
        if not self.trained_on:
            return tuple(index for index in known if index in self.held_out)
        return tuple(index for index in known if not self.learned_from(recordings, index))

    @property
    def scaled_spread(self) -> Array:
        """(A,) the spread of scaled actions; 0 for a number that never changes."""
        width = np.array(self.actions.high) - np.array(self.actions.low)
        return np.where(width > 0, 2 * np.array(self.spread) / np.where(width > 0, width, 1), 0)

    def distance(self, actions: Array, others: Array) -> Array:
        """(..., A) scaled actions twice -> (...): ``scaling.apart`` in their spread."""
        return apart(actions, others, self.scaled_spread)

    def outside(self, states: Array) -> Array:
        """(..., S) raw -> bool: the numbers outside the range of the recordings in training."""
        low = np.array(self.states.low)
        high = np.array(self.states.high)
        slack = 1e-6 * np.maximum(np.abs(low), np.abs(high))
        return (states < low - slack) | (states > high + slack)

    def check(self, recordings: Recordings) -> None:
        """Raises UserError for recordings of a robot with other cameras, numbers or rate."""
        ours = {one.name: one for one in recordings.cameras}
        pairs = [(one, ours[one.name]) for one in self.cameras if one.name in ours]
        facts = (
            ("cameras", [one.name for one in self.cameras], [c.name for c in recordings.cameras]),
            ("states", list(self.state_names), list(recordings.state_names)),
            ("actions", list(self.action_names), list(recordings.action_names)),
            ("columns of pictures", [one.key for one, _ in pairs], [c.key for _, c in pairs]),
            ("width to height", [_aspect(one) for one, _ in pairs], [_aspect(c) for _, c in pairs]),
            ("steps a second", [f"{self.fps:g}"], [f"{recordings.fps:g}"]),
        )
        for what, expected, found in facts:
            if set(expected) - set(found) or (what != "cameras" and expected != found):
                raise UserError(
                    f"{recordings.path}: expected the policy's {what} {', '.join(expected):.200}, "
                    f"found {', '.join(found):.200}; name recordings of the same robot"
                )

    def check_units(self, recordings: Recordings) -> None:
        """Raises UserError for recordings of another robot, and for those whose numbers have
        another range: the explorer shows them in units of the recordings."""
        self.check(recordings)
        if (self.states, self.actions) != recordings.scalings():
            raise UserError(
                f"{recordings.path}: expected the recordings that the policy learned from, found "
                "states or actions of another range, or another episode held out; `madviz audit "
                "--recording` converts them"
            )


def _aspect(camera: RecordedCamera) -> str:
    return f"{camera.name} {Fraction(camera.width, camera.height)}"


@lru_cache(maxsize=8)
def robot_of(recordings: Recordings) -> Robot:
    """The robot of ``recordings``, its scalings from the episodes for training."""
    states, actions = recordings.scalings()
    cameras = [RecordedCamera(c.key, c.name, c.height, c.width) for c in recordings.cameras]
    return Robot(
        tuple(cameras),
        recordings.state_names,
        recordings.action_names,
        states,
        actions,
        tuple(recordings.action_spread().tolist()),
        recordings.fps,
        recordings.held_out,
        frozenset(map(recordings.digest, recordings.training)),
    )


def robot_for_any_policy(recordings: Recordings) -> Robot:
    """The robot of ``recordings``, for a policy that does not say which episodes it was trained
    on."""
    return replace(robot_of(recordings), trained_on=frozenset())


def robot_document(robot: Robot) -> dict[str, object]:
    """The content of robot.json, but for the digests of episodes."""
    return {
        "schema": 1,
        "fps": robot.fps,
        "cameras": [
            {"key": c.key, "name": c.name, "height": c.height, "width": c.width}
            for c in robot.cameras
        ],
        "state": {"names": list(robot.state_names), **robot.states.to_json()},
        "action": {
            "names": list(robot.action_names),
            **robot.actions.to_json(),
            "spread": list(robot.spread),
        },
        "held_out": list(robot.held_out),
    }


def write_robot(folder: Path, robot: Robot) -> None:
    """Writes robot.json into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / FILE, {**robot_document(robot), "trained_on": sorted(robot.trained_on)})


def read_robot(folder: Path) -> Robot:
    """Reads robot.json of a policy folder. Raises UserError for one that is not there or wrong."""
    where = folder / FILE
    if not where.is_file():
        raise UserError(f"{where}: expected the robot of the policy, found no such file; {FIX}")
    file = typed(read_json(where), _File, where, FIX)
    for what, numbers in (("state", file.state), ("action", file.action)):
        spread = numbers.spread if what == "action" else numbers.names
        if not len(numbers.names) == len(numbers.low) == len(numbers.high) == len(spread):
            raise UserError(f"{where}: expected as many names as numbers in {what!r}; {FIX}")
        if any(low > high for low, high in zip(numbers.low, numbers.high, strict=True)):
            raise UserError(f"{where}: expected low below high in {what!r}; {FIX}")
    if not all(spread > 0 for spread in file.action.spread):
        raise UserError(f"{where}: expected a spread above 0 for each action number; {FIX}")
    if not all(0 < n <= 4096 for camera in file.cameras for n in (camera.height, camera.width)):
        raise UserError(f"{where}: expected cameras of 1 to 4096 pixels; {FIX}")
    return Robot(
        tuple(file.cameras),
        tuple(file.state.names),
        tuple(file.action.names),
        Scaling(tuple(file.state.low), tuple(file.state.high)),
        Scaling(tuple(file.action.low), tuple(file.action.high)),
        tuple(file.action.spread),
        file.fps,
        tuple(file.held_out),
        frozenset(file.trained_on),
    )
