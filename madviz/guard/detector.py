"""Says for each stream of pictures whether its camera works, one step at a time.

    guard = Guard(read_values(Path("guard.json"), "madviz guard --policy P"))
    verdicts = guard.step({"first": picture, "third_a": None}, state)
    verdicts["third_a"]       CameraVerdict(kind="gone", since=0, why="no picture came")

Pictures and state go in, verdicts come out. What a verdict needs of the past is kept here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from madviz.errors import UserError
from madviz.guard.lag import LAGS, LagTest, Path
from madviz.guard.pictures import PictureSums, sums_of
from madviz.guard.values import GuardValues, StreamValues
from madviz.types import Array

Kind = Literal["fine", "gone", "black", "covered", "noise", "blurred", "frozen", "lossy", "late"]
CONFIRM: dict[Kind, int] = {"covered": 2, "blurred": 2}
"""Steps in a row before a camera is left out; 1 for other kinds."""
LATE = 3
"""Steps in a row in which lags must say that a picture is late."""
STALE = ("frozen", "lossy", "late")
"""Kinds that only new pictures end."""
SMALLEST = 0.01
"""Movements up to this are none, in units of the state."""
COVERED = 20
"""Cells that are dark beyond the usual count where a lens is covered."""
GOOD = 3
"""Good pictures in a row before a camera is used again."""
LOSSY = 20
"""Steps within which a second freeze makes a camera lossy."""


@dataclass(frozen=True)
class CameraVerdict:
    """The state of one stream."""

    kind: Kind = "fine"
    since: int | None = None
    """The step at which it was noticed; None for a stream that is fine."""
    why: str = ""

    @property
    def fine(self) -> bool:
        return self.kind == "fine"


class Guard:
    """Watches the streams of one episode after the other."""

    def __init__(self, values: GuardValues) -> None:
        self.values = values
        self._places = list(values.state)
        self._unit = np.array(values.unit)
        self.restart()

    def restart(self) -> None:
        """Another episode begins."""
        self.now = 0
        self._states = np.zeros((0, len(self._places)))
        """(LAGS + 1, numbers), the newest first; empty before the first step."""
        self._watched = {
            name: _Stream(usual, self.values) for name, usual in self.values.streams.items()
        }

    def __copy__(self) -> Self:
        """A guard that goes on from here by itself."""
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._watched = {name: copy(stream) for name, stream in self._watched.items()}
        return other

    def step(self, pictures: Mapping[str, Array | None], state: Array) -> dict[str, CameraVerdict]:
        """The verdict on each of ``pictures``, (H, W, 3) uint8, or (H, W, 1) of depth, by stream;
        None: no picture came. ``state`` (S,) is the robot's now. A stream that is not named is not
        watched at this step, and its past is forgotten. Raises UserError for an unknown stream, a
        picture of another size, and a state that lacks numbers or is not finite."""
        for name in pictures:
            if name not in self._watched:
                raise UserError(
                    f"expected pictures of {', '.join(self._watched)}, found {name!r:.60}; fit the "
                    "guard on it first"
                )
        state = np.asarray(state, np.float64)
        if state.ndim != 1 or len(state) <= max(self._places) or not np.isfinite(state).all():
            raise UserError(
                f"expected a state of {max(self._places) + 1} finite numbers or more, found one of "
                f"shape {state.shape}"
            )
        here = (state[self._places] / self._unit)[None]  # (1, numbers)
        # Before its first step, the robot stood there.
        before = self._states[:-1] if len(self._states) else np.repeat(here, LAGS, 0)
        self._states = np.concatenate([here, before])
        path = Path.of(self._states)
        for name, stream in self._watched.items():
            if name in pictures:
                stream.take(pictures[name], path, self.now)
            else:
                stream.restart()
        self.now += 1
        return {name: self._watched[name].verdict for name in pictures}

    def good(self, name: str) -> bool:
        """Returns True where the newest picture of a stream is one to keep: a verdict of *covered*
        or *blurred* comes one picture late."""
        return self._watched[name].good


class _Stream:
    """One stream: what its last pictures were, and the verdict on it."""

    def __init__(self, usual: StreamValues, values: GuardValues) -> None:
        self._values = usual
        self._size = values.size
        self._reach = np.maximum(2 * np.array(usual.reach), SMALLEST)  # (numbers,)
        self._lag = LagTest(usual, len(values.state))
        self.restart()

    def __copy__(self) -> Self:
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._past = self._past.copy()
        other._stops = self._stops.copy()
        other._lag = copy(self._lag)  # Its arrays are replaced, never changed.
        return other

    def restart(self) -> None:
        self.verdict = CameraVerdict()
        self._suspect: Kind = "fine"
        self._suspected = 0
        self._good = 0
        self._behind = 0
        """Steps by which the pictures are known to be late."""
        self._forget()

    @property
    def good(self) -> bool:
        """The stream is fine, and its newest picture raised no suspicion."""
        return self.verdict.fine and self._suspect == "fine"

    def _forget(self) -> None:
        """Forgets the pictures: the next one is not compared with any. One that was lost does not
        show that a late camera is on time, unless nothing ever could."""
        if not self._lag.possible:
            self._behind = 0
        self._lag.restart()
        self._past: deque[PictureSums] = deque(maxlen=LAGS)
        """The pictures that came, the newest first."""
        self._anchor = np.zeros(0)
        """Where the robot was when the picture last changed."""
        self._repeats = 0
        """Steps since the picture last changed."""
        self._stopped = False
        """True where the picture has not changed since a freeze was noticed."""
        self._lags = 0
        """Steps in a row in which lags say that the picture is late."""
        self._stops: deque[int] = deque(maxlen=2)
        """The steps at which the last two freezes were noticed."""

    def take(self, picture: Array | None, path: Path, now: int) -> None:
        """Takes the picture of step ``now`` and decides."""
        kind, why = self._judge(picture, path, now)
        if self.verdict.fine:
            self._suspected = self._suspected + 1 if kind == self._suspect else 1
            self._suspect = kind
            if kind != "fine" and self._suspected >= CONFIRM.get(kind, 1):
                self.verdict = CameraVerdict(kind, now, why)
                self._good = 0
            return
        # A repeated picture does not show that a camera runs again.
        stands = self._repeats > 0 and self.verdict.kind in STALE
        self._good = self._good + 1 if kind == "fine" and not stands else 0
        if self._good == GOOD:
            self.verdict = CameraVerdict()
        elif kind not in ("fine", self.verdict.kind):
            self.verdict = CameraVerdict(kind, self.verdict.since, why)

    def _judge(self, picture: Array | None, path: Path, now: int) -> tuple[Kind, str]:
        """The kind that this step suggests, and why."""
        if picture is None:
            self._forget()
            return "gone", "no picture came"
        if np.shape(picture)[:2] != self._size:
            rows, columns = self._size
            raise UserError(
                f"expected pictures of {rows} by {columns}, as the guard was fitted on, found "
                f"{np.shape(picture)}; resize them, or fit the guard again"
            )
        sums = sums_of(picture)
        kind, why = self._by_itself(sums)
        if kind == "fine":
            return self._in_time(sums, path, now)
        self._forget()
        return kind, why

    def _by_itself(self, sums: PictureSums) -> tuple[Kind, str]:
        """The kinds that one picture shows."""
        usual = self._values
        if sums.spread < 0.25 * usual.spread:
            return "black", f"an even picture: cells differ by {sums.spread:.0f}"
        if sums.dark >= usual.dark + COVERED:
            return "covered", f"{sums.dark} of {len(sums.cells)} cells are black"
        if sums.rough > 1.5 * usual.rough:
            return "noise", f"roughness {sums.rough}; {usual.rough} or less is usual"
        if sums.edges < 0.4 * usual.edges:
            return "blurred", f"{sums.edges} edges; {usual.edges} or more are usual"
        return "fine", ""

    def _in_time(self, sums: PictureSums, path: Path, now: int) -> tuple[Kind, str]:
        """The kinds that only a comparison with the past shows."""
        before = self._past[0] if self._past else None
        replayed = self._replayed(sums, path)
        self._past.appendleft(sums)
        if before is None:
            self._anchor = path.states[0]
            return "fine", ""
        change = sums.cells - before.cells  # (441,)
        if sums.spread == before.spread and not change.any():  # The first alone is mostly enough.
            return self._repeated(path, now)
        stood = self._repeats
        self._repeats = 0
        self._stopped = False
        self._anchor = path.states[0]
        if replayed:
            self._is_behind(replayed)
        elif stood:
            behind = self._behind + stood
            caught_up = self._lag.caught_up(change, path, behind)
            if caught_up is not None:
                self._is_behind(0 if caught_up else behind)
        elif self._behind and self._lag.caught_up(change, path, self._behind, clearly=True):
            self._is_behind(0)
        else:
            self._compare_lags(change, path)
        if self._behind:
            return "late", f"the picture shows what was {self._behind} steps ago"
        return "fine", ""

    def _compare_lags(self, change: Array, path: Path) -> None:
        """Lateness that no repeated picture has shown, and its end."""
        self._lag.add(change, path)
        if self._behind:
            if self._lag.on_time():
                self._is_behind(0)
            return
        lag = self._lag.lag()
        self._lags = self._lags + 1 if lag else 0
        if self._lags == LATE:
            self._is_behind(lag)

    def _is_behind(self, steps: int) -> None:
        self._behind = steps
        self._lags = 0
        self._lag.restart()

    def _repeated(self, path: Path, now: int) -> tuple[Kind, str]:
        """The picture is the last one again. That is a fault only where the robot moved."""
        self._repeats += 1
        if not self._moved(path.states[0], self._anchor):
            return ("late", "it was late, and the robot stands") if self._behind else ("fine", "")
        if not self._stopped:
            self._stopped = True
            self._stops.append(now)
        lossy = len(self._stops) == 2 and self._stops[1] - self._stops[0] <= LOSSY
        why = f"the robot moved, and the picture is the same for {self._repeats} steps"
        return ("lossy" if lossy else "frozen"), why

    def _replayed(self, sums: PictureSums, path: Path) -> int:
        """How many steps ago this picture came before, where the robot was elsewhere then; 0 if it
        is new or the last one again."""
        for ago, past in enumerate(self._past, 1):
            if past.spread == sums.spread and np.array_equal(past.cells, sums.cells):
                moved = self._moved(path.states[0], path.states[ago])
                return ago if moved and ago > 1 else 0
        return 0

    def _moved(self, here: Array, there: Array) -> bool:
        """Returns True where a working camera would show that the robot is elsewhere."""
        return bool((np.abs(here - there) > self._reach).any())
