"""The benchmarks' arithmetic, with a clock that the test winds."""

from __future__ import annotations

from pathlib import Path

import pytest

from madviz.bench import live as bench_live
from madviz.bench.render import Frames, RenderConfig, alternate, bench_render
from madviz.recipes import training_job
from madviz.recipes.training_job import JobConfig, JobStatus, State
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


class FakeJob:
    """A training that has begun, and goes on or ends."""

    ends_as: State = "running"
    last: FakeJob

    def __init__(self, root: Path) -> None:
        self.measured = False
        FakeJob.last = self

    def start(self, config: JobConfig) -> None:
        self.config = config

    def status(self) -> JobStatus:
        row = {"round": 1.0}
        return JobStatus(self.ends_as if self.measured else "running", rows=(row,), why="killed")

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("ends_as", ["running", "failed"])
def test_the_page_is_measured_beside_a_training_that_lasts(monkeypatch, ends_as) -> None:
    def measure(config: bench_live.LiveConfig, workers: int) -> dict[str, float]:
        FakeJob.last.measured = True
        return {"updates_per_s": 17.0}

    monkeypatch.setattr(bench_live, "measure", measure)
    monkeypatch.setattr(training_job, "TrainingJob", FakeJob)
    monkeypatch.setattr(FakeJob, "ends_as", ends_as)
    config = bench_live.LiveConfig(policy="metaworld-hammer-mad-light", training=True)
    if ends_as == "running":
        assert bench_live.beside_training(config) == {"updates_per_s": 17.0}
    else:
        with pytest.raises(UserError, match="found it failed: killed"):
            bench_live.beside_training(config)
    assert FakeJob.last.closed and FakeJob.last.config.task == "metaworld/hammer"
