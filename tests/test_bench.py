"""The benchmarks' arithmetic, with a clock that the test winds."""

from __future__ import annotations

import pytest

from madviz.bench import Frames, RenderConfig, alternate, bench_render
from madviz.types import UserError


class FakeFrames:
    """Takes the given times to draw and a minute to step, on a clock that all sides share."""

    def __init__(self, name: str, times: list[float], clock: list[float], log: list[str]) -> None:
        self._name, self._times, self._clock, self._log = name, times, clock, log

    def step(self) -> None:
        self._clock[0] += 60

    def draw(self) -> None:
        self._clock[0] += self._times.pop(0)
        self._log.append(self._name)


def test_sides_take_turns_and_neither_steps_nor_the_first_round_count() -> None:
    clock, log = [0.0], []
    sides: dict[str, Frames] = {
        "ours": FakeFrames("ours", [9, 0.010, 0.020, 0.090], clock, log),
        "stock": FakeFrames("stock", [9, 0.200, 0.100, 0.400], clock, log),
    }
    medians = alternate(sides, rounds=3, clock=lambda: clock[0])
    assert medians == pytest.approx({"ours": 20, "stock": 200})
    assert log == ["ours", "stock", "stock", "ours"] * 2


@pytest.mark.parametrize("bad", [RenderConfig(task="toy/reach"), RenderConfig(rounds=0)])
def test_what_cannot_be_measured_is_refused(bad: RenderConfig) -> None:
    with pytest.raises(UserError, match="expected"):
        bench_render(bad)
