"""Maps of features: the right axes, and the same ones for ever."""

from __future__ import annotations

import numpy as np
import pytest

from madviz.analysis.projection import FeatureMaps, fit
from madviz.errors import UserError


def cloud(count: int, width: int, seed: int = 0) -> np.ndarray:
    """Points that differ a lot in two directions and little in the others."""
    rng = np.random.default_rng(seed)
    scale = np.concatenate([[9.0, 4.0], np.full(width - 2, 0.3)])
    turn = np.linalg.qr(rng.normal(size=(width, width)))[0]
    return (rng.normal(size=(count, width)) * scale @ turn + 5).astype(np.float32)


def test_the_axes_are_the_principal_ones() -> None:
    rows = cloud(60, 20).astype(np.float64)
    basis = fit(rows)
    _, spread, directions = np.linalg.svd(rows - rows.mean(0), full_matrices=False)
    np.testing.assert_allclose(np.abs(basis.axes @ directions[:2].T), np.eye(2), atol=1e-8)
    np.testing.assert_allclose(basis.axes @ basis.axes.T, np.eye(2), atol=1e-8)
    assert basis.share == pytest.approx((spread[:2] ** 2).sum() / (spread**2).sum())
    assert (np.take_along_axis(basis.axes, np.abs(basis.axes).argmax(1)[:, None], 1) > 0).all()


def test_a_map_has_the_range_of_what_it_was_made_of() -> None:
    rows = cloud(30, 8)
    basis = fit(rows)
    points = basis.project(rows)
    np.testing.assert_allclose([points.min(0), points.max(0)], [basis.low, basis.high], atol=1e-5)
    np.testing.assert_allclose(points.mean(0), 0, atol=1e-5)


def test_projecting_keeps_distances_within_the_plane() -> None:
    basis = fit(cloud(30, 8))
    shift = 3 * basis.axes[0] - 4 * basis.axes[1]
    a, b = basis.project(np.stack([basis.mean, basis.mean + shift]))
    np.testing.assert_allclose(b - a, [3, -4], atol=1e-9)


def test_features_on_a_line_have_one_axis() -> None:
    basis = fit(np.outer(np.arange(5.0), [3.0, 4.0]))
    np.testing.assert_allclose(basis.axes, [[0.6, 0.8], [0, 0]], atol=1e-9)
    assert basis.share == pytest.approx(1)
    assert fit(np.zeros((4, 6))).share == 0


def test_a_map_is_made_once_and_never_moves() -> None:
    atlas, rows = FeatureMaps(decisions=4), cloud(60, 10)
    for step in range(4):
        assert atlas.map("p") is None and atlas.progress("p") == step / 4
        atlas.collect("p", rows[3 * step : 3 * step + 3])
    kept = atlas.map("p")
    assert kept is not None and atlas.progress("p") == 1
    np.testing.assert_array_equal(kept.axes, fit(rows[:12]).axes)
    for step in range(4, 12):
        atlas.collect("p", 100 * rows[3 * step : 3 * step + 3])
    assert atlas.map("p") is kept


def test_every_policy_has_a_map_of_its_own_width() -> None:
    atlas = FeatureMaps(decisions=2)
    for _ in range(2):
        atlas.collect("wide", cloud(3, 10))
        atlas.collect("narrow", cloud(3, 5))
    wide, narrow = atlas.map("wide"), atlas.map("narrow")
    assert wide is not None and narrow is not None
    assert (wide.axes.shape, narrow.axes.shape) == ((2, 10), (2, 5))


def test_broken_features_make_no_map() -> None:
    atlas = FeatureMaps(decisions=1)
    atlas.collect("p", np.full((3, 4), np.nan))
    assert atlas.map("p") is None and atlas.progress("p") == 0
    for rows in (np.zeros((1, 4)), np.full((3, 4), np.inf)):
        with pytest.raises(UserError, match="two or more finite features"):
            fit(rows)
