"""Drivers and row weights that follow where the student fails, against counts by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.runs.run_folder import RunFolder
from madviz.training.light import LightRun
from madviz.training.light_focus import ROUNDS, failures, focused, in_turn, shares
from tests.plans import THREE, InlineRecorder, toy_plan
from tests.test_light import TINY, finish, run_in


def test_failures_are_counted_over_the_latest_rounds_from_one_of_each() -> None:
    old = [[(0, False)] * 50]
    new = [[(0, True), (1, False)], [(1, False), (1, True)], [(0, True)]]
    assert len(new) == ROUNDS
    assert failures(old + new, 3).tolist() == [1 / 4, 3 / 5, 1 / 2]


def test_shares_are_the_formula() -> None:
    failed = np.array([0.1, 0.1, 0.8, 0.6])
    assert shares(failed, 0.0) == pytest.approx([0.25] * 4)
    assert shares(failed, 1.0) == pytest.approx(failed / 1.6)
    half = shares(failed, 0.5)
    assert half == pytest.approx(0.125 + 0.5 * failed / 1.6) and half.sum() == pytest.approx(1)
    # The example at the top of the module.
    assert half.round(2).tolist() == [0.16, 0.16, 0.38, 0.31]
    assert np.bincount(in_turn(half, 8, 0)).tolist() == [1, 1, 3, 3]


@pytest.mark.parametrize("first", range(5))
@pytest.mark.parametrize("count", [1, 3, 4])
def test_equal_shares_are_taken_in_turn(count: int, first: int) -> None:
    even = np.full(count, 1 / count)
    assert in_turn(even, 8, first) == [number % count for number in range(first, first + 8)]


def test_weights_of_single_rows_are_shared_out_and_the_merged_row_keeps_its_own() -> None:
    masks = np.array([[1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], bool)
    weights = np.array([0.25, 0.25, 0.25, 0.25], np.float32)
    part = np.array([0.7, 0.05, 0.15, 0.1])
    found = focused(weights, masks, list(masks), part)
    assert found == pytest.approx([0.25, 0.75 / 6, 0.75 / 2, 0.75 / 3])
    assert weights.tolist() == [0.25] * 4, "the caller's stay"
    # A row that never drives keeps its weight.
    assert focused(weights, masks, list(masks[:3]), part[:3]) == pytest.approx(
        [0.25, 0.125, 0.375, 0.25]
    )
    assert focused(np.ones(1), masks[:1], [masks[0]], np.ones(1)).tolist() == [1.0]


def test_a_run_learns_more_where_it_fails(tmp_path: Path) -> None:
    config = replace(TINY, focus=1.0)
    run = run_in(RunFolder(tmp_path, config, resume=False, listener=None), config)
    lost = [(0, True)] * 8 + [(1, True)] * 8 + [(2, False)] * 8 + [(3, True)] * 8
    run.outcomes = [lost]
    drivers = [tuple(driver.mask) for driver, _ in run.drivers(2) if driver.mask is not None]
    third_a = tuple(stream == "third_a" for stream in THREE)
    assert drivers.count(third_a) == 3 and len(drivers) == 4
    run.data.add(InlineRecorder().start(run.drivers(0)[:1])[0].result())
    run.learn()
    even = run.plan.method.row_weights(THREE, run.config.alpha)
    assert run.weights[0] == even[0] and run.weights[2] > 5 * run.weights[1]
    assert float(run.weights.sum()) == pytest.approx(1)


def test_without_focus_weights_and_drivers_are_those_of_before(tmp_path: Path) -> None:
    run = run_in(RunFolder(tmp_path, TINY, resume=False, listener=None))
    run.outcomes = [[(2, False)] * 8]
    seen = [tuple(driver.mask) for driver, _ in run.drivers(1) if driver.mask is not None]
    assert seen == [tuple(run.driven[number % 4]) for number in range(2, 6)]


def test_outcomes_say_who_drove(tmp_path: Path) -> None:
    config = replace(TINY, focus=0.5)
    folder = RunFolder(tmp_path, config, resume=False, listener=None)
    run: LightRun = run_in(folder, config)
    with pytest.raises(KeyboardInterrupt):
        finish(run, folder, InlineRecorder(breaks_after=3))
    assert [len(found) for found in run.outcomes] == [4, 4]
    assert sorted(index for index, _ in run.outcomes[0]) == [0, 1, 2, 3]
    again = LightRun(toy_plan(), config, folder.resume)
    state = folder.load_state()
    assert state is not None
    again.restore(state)
    assert again.outcomes == [[tuple(each) for each in found] for found in run.outcomes]
