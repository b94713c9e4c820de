"""What a probe says of its numbers: lengths, angles, shares, and how they were merged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from madviz.analysis.probes import Probe, probe
from madviz.subsets import every_mask
from madviz.types import Array, Encoded, Readout
from tests.fakes import AllOrNothing, FakePolicy

FEATURES = np.abs(np.random.default_rng(0).normal(size=(3, 16))).astype(np.float32)


def probe_of(merged: Array, features: Array = FEATURES, supported: Array | None = None) -> Probe:
    masks = every_mask(len(features))
    action, q = np.zeros((len(masks), 2), np.float32), np.zeros(len(masks), np.float32)
    known = np.ones(len(masks), bool) if supported is None else supported
    return Probe(features, masks, known, Readout(merged.astype(np.float32), action, q), known)


def summed(features: Array = FEATURES) -> Array:
    return every_mask(len(features)).astype(np.float32) @ features


def averaged() -> Array:
    return summed() / np.maximum(every_mask(3).sum(1, keepdims=True), 1)


def test_every_mask_has_its_row() -> None:
    found = probe_of(summed())
    assert [found.row(mask) for mask in found.masks] == list(range(8))


@pytest.mark.parametrize("merged", [summed(), averaged()], ids=["sum", "mean"])
def test_shares_of_a_sum_or_a_mean_add_up_to_one(merged: Array) -> None:
    found = probe_of(merged)
    for row in range(7):
        shares, mask = found.shares(row), found.masks[row]
        assert shares.sum() == pytest.approx(1, abs=1e-5)
        assert (shares[~mask] == 0).all() and (shares[mask] > 0).all()
    assert np.isnan(found.shares(7)).all(), "nothing has no shares"


def test_shares_are_what_is_left_out_when_projected() -> None:
    """V_i . M / |M|^2 by hand, for two features at right angles of length 3 and 4."""
    features = np.array([[3, 0], [0, 4]], np.float32)
    found = probe_of(summed(features), features)
    np.testing.assert_allclose(found.shares(0), [9 / 25, 16 / 25], rtol=1e-6)
    np.testing.assert_allclose(found.cosines(0), [3 / 5, 4 / 5], rtol=1e-6)


def test_how_features_were_merged_is_told_from_the_numbers() -> None:
    assert probe_of(summed()).merged_kind() == "sum"
    assert probe_of(averaged()).merged_kind() == "mean"
    assert probe_of(summed() ** 2).merged_kind() == "other"
    assert probe_of(np.zeros((8, 48))).merged_kind() == "other"
    assert np.isnan(probe_of(np.ones((8, 48))).shares(0)).all()
    assert probe_of(np.ones((8, 16)), 0 * FEATURES).merged_kind() == "no views"


def test_features_rounded_to_half_precision_are_still_a_sum_and_do_not_overflow() -> None:
    features = 100 * FEATURES
    whole = probe_of(summed(features), features)
    rounded = replace(whole.readout, merged=whole.readout.merged.astype(np.float16))
    half = replace(whole, readout=rounded)
    assert half.merged_kind() == "sum" and half.merged_norm(0) > 300
    np.testing.assert_allclose(half.shares(0), whole.shares(0), rtol=1e-3)
    np.testing.assert_allclose(half.cosines(0), whole.cosines(0), rtol=1e-3)


def test_rows_that_cannot_be_read_do_not_hide_the_sum() -> None:
    merged, supported = summed(), np.zeros(8, bool)
    supported[0] = True
    merged[~supported] = np.nan
    found = probe_of(merged, supported=supported)
    assert found.merged_kind() == "sum"
    assert np.isnan(found.shares(3)).all() and np.isfinite(found.shares(0)).all()


def test_subsets_that_a_policy_cannot_act_on_are_nan() -> None:
    views = np.zeros((3, 9, 84, 84), np.uint8) + 40
    policy = AllOrNothing()
    encoded: Encoded = policy.encode(views, np.zeros(4, np.float32))
    found = probe(policy, encoded)
    assert found.supported.tolist() == [True, *[False] * 7]
    assert np.isnan(found.readout.action[1:]).all() and np.isfinite(found.readout.q[0])
    assert probe(FakePolicy(), encoded).supported.all()
