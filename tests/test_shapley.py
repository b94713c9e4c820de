"""Shapley values against their definition: the average over all orders in which cameras come."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from madviz.analysis.probes import Probe
from madviz.analysis.shapley import (
    action_shapley,
    camera_masks,
    q_shapley,
    set_names,
    shapley,
    shares,
    success_interval,
    success_shapley,
)
from madviz.errors import UserError
from madviz.subsets import every_mask, mask_of
from madviz.types import Readout

THREE = ("first", "third_a", "third_b")
RGBD = tuple(f"{camera}.{kind}" for camera in THREE for kind in ("rgb", "depth"))
HALF = {"none": 0.0, "first": 0.2, "third_a": 0.6, "all": 1.0}


def by_orders(values: np.ndarray) -> np.ndarray:
    """The definition: what each player adds when it comes, averaged over every order."""
    count = len(values).bit_length() - 1
    place = {tuple(mask): i for i, mask in enumerate(every_mask(count).tolist())}
    worth, orders = np.zeros((count, *values.shape[1:])), list(permutations(range(count)))
    for order in orders:
        there = [False] * count
        for player in order:
            before = values[place[tuple(there)]]
            there[player] = True
            worth[player] += values[place[tuple(there)]] - before
    return worth / len(orders)


def probe_of(streams: tuple[str, ...], *, seed: int = 0, blind: bool = False) -> Probe:
    """Random actions and Q for every subset; ``blind``: it cannot act on the empty one."""
    rng, masks = np.random.default_rng(seed), every_mask(len(streams))
    action = rng.uniform(-1, 1, (len(masks), 4)).astype(np.float32)
    q = rng.normal(10, 3, len(masks)).astype(np.float32)
    supported = np.ones(len(masks), bool)
    if blind:
        supported[-1], action[-1], q[-1] = False, np.nan, np.nan
    readout = Readout(np.zeros((len(masks), 8), np.float32), action, q)
    return Probe(np.ones((len(streams), 8), np.float32), masks, supported, readout, supported)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_worth_is_the_mean_over_all_orders(count: int) -> None:
    values = np.random.default_rng(count).normal(size=2**count)
    np.testing.assert_allclose(shapley(values), by_orders(values), atol=1e-12)


def test_several_games_at_once() -> None:
    values = np.random.default_rng(7).normal(size=(8, 4))
    np.testing.assert_allclose(shapley(values), by_orders(values), atol=1e-12)


def test_worths_sum_to_what_there_is_to_share() -> None:
    values = np.random.default_rng(1).normal(size=32)
    assert shapley(values).sum() == pytest.approx(values[0] - values[-1], abs=1e-12)


def test_equal_cameras_get_equal_worth_and_idle_ones_nothing() -> None:
    first, second, _ = every_mask(3).T
    values = 3.0 * (first & second)
    np.testing.assert_allclose(shapley(values), [1.5, 1.5, 0.0], atol=1e-12)


def test_the_example_of_the_module() -> None:
    worth = success_shapley(HALF, ("first", "third_a"))
    assert worth is not None
    np.testing.assert_allclose(worth.cameras, [0.3, 0.7], atol=1e-12)
    assert (worth.empty, worth.full) == (0.0, 1.0)


def test_a_camera_is_one_player_with_all_its_streams() -> None:
    masks = camera_masks(RGBD)
    assert masks.shape == (8, 6)
    np.testing.assert_array_equal(masks[:, 0::2], masks[:, 1::2])
    probe = probe_of(RGBD)
    values = np.array([probe.readout.q[probe.row(mask)] for mask in masks], np.float64)
    worth = q_shapley(probe, RGBD)
    np.testing.assert_allclose(worth.cameras, by_orders(values), atol=1e-9)


def test_a_dropped_camera_is_worth_nothing_and_the_rest_share_what_is_left() -> None:
    probe, present = probe_of(THREE), mask_of("first+third_b", THREE)
    worth = q_shapley(probe, THREE, present)
    assert worth.cameras[1] == 0
    assert worth.full == pytest.approx(float(probe.readout.q[probe.row(present)]))
    assert worth.empty + worth.cameras.sum() == pytest.approx(worth.full)


def test_a_dropped_stream_leaves_its_camera_the_other_one() -> None:
    present = mask_of("rgb", RGBD)
    masks = camera_masks(RGBD, present)
    assert not masks[:, 1::2].any() and masks[0, 0::2].all()
    assert np.abs(q_shapley(probe_of(RGBD), RGBD, present).cameras).min() > 0


def test_the_action_is_shared_from_blind_to_seeing() -> None:
    probe = probe_of(THREE)
    action = probe.readout.action.astype(np.float64)
    values = -np.linalg.norm(action - action[0], axis=1)
    worth = action_shapley(probe, THREE)
    np.testing.assert_allclose(worth.cameras, by_orders(values), atol=1e-9)
    assert worth.full == 0
    assert worth.cameras.sum() == pytest.approx(np.linalg.norm(action[-1] - action[0]))


def test_a_camera_that_never_changes_the_action_is_worth_nothing() -> None:
    probe = probe_of(THREE)
    for row, mask in enumerate(probe.masks):
        twin = mask.copy()
        twin[2] = True
        probe.readout.action[row] = probe.readout.action[probe.row(twin)]
    assert action_shapley(probe, THREE).cameras[2] == pytest.approx(0, abs=1e-12)


def test_no_worth_where_the_policy_cannot_act_on_every_set() -> None:
    probe = probe_of(THREE, blind=True)
    assert np.isnan(q_shapley(probe, THREE).cameras).all()
    assert np.isnan(action_shapley(probe, THREE).cameras).all()


def test_success_needs_every_set_of_cameras() -> None:
    assert success_shapley({"all": 1.0, "none": 0.0, "first": 0.5}, ("first", "third_a")) is None
    assert success_shapley({**HALF, "first": float("nan")}, ("first", "third_a")) is None
    assert set_names(THREE) == (
        "all",
        "first+third_a",
        "first+third_b",
        "first",
        "third_a+third_b",
        "third_a",
        "third_b",
        "none",
    )


def test_fewer_sets_are_needed_while_a_camera_is_dropped() -> None:
    rates = {"first+third_a": 1.0, "first": 0.2, "third_a": 0.6, "none": 0.0}
    worth = success_shapley(rates, THREE, mask_of("first+third_a", THREE))
    assert worth is not None
    np.testing.assert_allclose(worth.cameras, [0.3, 0.7, 0.0], atol=1e-12)


def test_intervals_of_rates_become_intervals_of_worths() -> None:
    exact = {name: (rate, rate, rate) for name, rate in HALF.items()}
    low, high = success_interval(exact, ("first", "third_a"))
    np.testing.assert_allclose([low, high], [[0.3, 0.7]] * 2, atol=1e-12)
    vague = {**exact, "first": (0.2, 0.1, 0.4)}
    low, high = success_interval(vague, ("first", "third_a"))
    # ``first`` counts half for itself, minus half for the other: the ends change places there.
    np.testing.assert_allclose(low, [0.25, 0.6], atol=1e-12)
    np.testing.assert_allclose(high, [0.4, 0.75], atol=1e-12)


def test_the_interval_covers_what_chance_does() -> None:
    """Wilson ends are 1.96 standard errors away here, so the worth's must be, too."""
    rng, n, rate = np.random.default_rng(0), 400, 0.5
    drawn = rng.binomial(n, rate, (4000, 8)) / n
    spread = (drawn @ shares(3).T).std(0)
    error = 1.96 * np.sqrt(rate * (1 - rate) / n)
    low, high = success_interval(
        dict.fromkeys(set_names(THREE), (rate, rate - error, rate + error)), THREE
    )
    np.testing.assert_allclose((high - low) / 2, 1.96 * spread, rtol=0.06)


def test_a_dropped_camera_has_no_doubt_about_its_worth() -> None:
    names = ("first+third_a", "first", "third_a", "none")
    rates = {name: (0.5, 0.3, 0.7) for name in names}
    low, high = success_interval(rates, THREE, mask_of("first+third_a", THREE))
    assert low[2] == high[2] == 0 and high[0] > 0.1


def test_wrong_numbers_of_sets_are_refused() -> None:
    with pytest.raises(UserError, match="expected a value for each of 2\\^C sets"):
        shapley(np.zeros(6))
    with pytest.raises(UserError, match="one camera or more"):
        shapley(np.zeros(1))
