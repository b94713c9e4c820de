"""The benchmarks' arithmetic, with a clock that the test sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import evaluate as bench_evaluate
from benchmarks import live as bench_live
from benchmarks.render import Frames, RenderConfig, alternate, bench_render
from madviz.errors import UserError
from madviz.measure.episodes import Finished, Job
from madviz.measure.store import EpisodeResult
from madviz.measure.workers import Workers
from madviz.observation.condition import Condition
from madviz.training import job
from madviz.training.job import JobConfig, JobStatus, State
from madviz.types import Encoded
from tests.fakes import FakePolicy


class FakeFrames:
    """Takes the given times to draw and a minute to step, on a clock that all sides share."""

    def __init__(self, name: str, times: list[float], clock: list[float], log: list[str]) -> None:
        self._name, self._times, self._clock, self._log = name, times, clock, log

    def step(self) -> None:
        self._clock[0] += 60

    def draw(self) -> list:
        self._clock[0] += self._times.pop(0)
        self._log.append(self._name)
        return []

    def close(self) -> None: ...


def test_both_sides_alternate_and_only_draws_after_the_first_round_are_timed() -> None:
    clock, log = [0.0], []
    sides: dict[str, Frames] = {
        "ours": FakeFrames("ours", [9, 0.010, 0.020, 0.090], clock, log),
        "stock": FakeFrames("stock", [9, 0.200, 0.100, 0.400], clock, log),
    }
    medians = alternate(sides, rounds=3, clock=lambda: clock[0])
    assert medians == pytest.approx({"ours": 20, "stock": 200})
    assert log == ["ours", "stock", "stock", "ours"] * 2


def test_tasks_without_stock_renderer_are_refused() -> None:
    with pytest.raises(UserError, match="expected"):
        bench_render(RenderConfig(task="toy/reach"))


class Clock:
    """Returns what a test has set."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class FakeStock:
    """Draws for 0.9 s and steps for 0.05; the first picture takes a minute."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._first, self.steps = clock, True, 0

    def draw(self) -> list[np.ndarray]:
        self._clock.now += 60.0 if self._first else 0.9
        self._first = self.steps == 0
        return [np.full((84, 84, 3), number, np.uint8) for number in range(3)]

    def step(self) -> None:
        self.steps += 1
        self._clock.now += 0.05

    def close(self) -> None: ...


def test_a_stock_decision_is_pictures_policy_and_all_its_steps() -> None:
    clock, seen = Clock(), []

    class Looking(FakePolicy):
        def encode(self, views: np.ndarray, state: np.ndarray) -> Encoded:
            seen.append(views)
            return super().encode(views, state)

    frames, everything = FakeStock(clock), np.ones(3, bool)
    seconds = bench_evaluate.stock_seconds(frames, Looking(), everything, 2, 4, clock)
    assert seconds == pytest.approx(0.9 + 2 * 0.05) and frames.steps == 10
    assert seen[0].shape == (3, 9, 84, 84) and seen[0][2].max() == seen[0][2].min() == 2
    with pytest.raises(UserError, match="RGB of three cameras"):
        six = FakePolicy(setting="three-rgbd")
        bench_evaluate.stock_seconds(frames, six, np.ones(6, bool), 2, 4, clock)


class FakeRunner:
    """Runs a job in ten seconds; the first one takes a minute."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._runs = clock, 0

    def run(self, job: Job) -> Finished:
        self._runs += 1
        self._clock.now += 60.0 if self._runs == 1 else 10.0
        return EpisodeResult("all", job.seed, True, True, 1.0), "reached"


def test_a_plain_loop_is_timed_without_its_first_episode() -> None:
    clock = Clock()
    jobs = [Job("toy", "digest", Condition("all"), seed) for seed in range(3)]
    seconds, found = bench_evaluate.in_turn(jobs, FakeRunner(clock), clock)  # type: ignore[arg-type]
    assert seconds == 30.0 and [found[job][0].seed for job in jobs] == [0, 1, 2]


def test_different_results_of_the_two_loops_are_an_error(monkeypatch) -> None:
    def ours(jobs: list[Job], workers: Workers) -> tuple[float, dict[Job, Finished]]:
        return 3.0, {job: (EpisodeResult("all", job.seed, True, True, 1.0), "x") for job in jobs}

    def serial(jobs: list[Job], runner: object) -> tuple[float, dict[Job, Finished]]:
        return 6.0, {job: (EpisodeResult("all", job.seed, False, True, 1.0), "x") for job in jobs}

    monkeypatch.setattr(bench_evaluate, "in_workers", ours)
    monkeypatch.setattr(bench_evaluate, "in_turn", serial)
    with pytest.raises(UserError, match="same results of both loops"):
        bench_evaluate.bench_evaluate(bench_evaluate.BenchEvaluateConfig(episodes=2))


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(UserError, match="nobody"):
        bench_evaluate.bench_evaluate(bench_evaluate.BenchEvaluateConfig(policy="nobody"))


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
    monkeypatch.setattr(job, "TrainingJob", FakeJob)
    monkeypatch.setattr(FakeJob, "ends_as", ends_as)
    config = bench_live.LiveConfig(policy="metaworld-hammer-mad-light", training=True)
    if ends_as == "running":
        assert bench_live.beside_training(config) == {"updates_per_s": 17.0}
    else:
        with pytest.raises(UserError, match="found it failed: killed"):
            bench_live.beside_training(config)
    assert FakeJob.last.closed and FakeJob.last.config.task == "metaworld/hammer"
