"""Which pixels an action depends on, from outside: made-up policies that look at one known place,
and at none."""

from __future__ import annotations

import numpy as np
import pytest

from madviz.analysis.covering import covered
from madviz.measure import attention
from madviz.measure.attention import place_words
from madviz.measure.episodes import Job, Runner
from madviz.observation.condition import Condition
from madviz.types import Encoded, Readout
from tests.fakes import FakePolicy

V, SIDE = 3, 84
MASK = np.ones(V, bool)


class PlacePolicy(FakePolicy):
    """Acts by the mean colour of 12 x 12 pixels of one stream; without a place it is blind."""

    def __init__(self, stream: int = 0, place: tuple[int, int] | None = None) -> None:
        super().__init__()
        self._stream, self._place = stream, place

    def encode(self, views, state):
        features = np.zeros((V, 2), np.float32)
        if self._place:
            row, column = self._place
            part = views[self._stream, -3:, row : row + 12, column : column + 12]
            features[self._stream] = np.tanh(part[:2].mean((1, 2)) / 127.5 - 1)
        return Encoded(features, state)

    def read(self, encoded, masks):
        action = np.atleast_2d(masks) @ encoded.features
        return Readout(action, action, np.zeros(len(action)))


def pictures(rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A smooth frame with a stack of three, mean pictures, and another frame."""
    coarse = rng.uniform(0, 255, (3, V, 3, 6, 6))
    first, mean, other = coarse.repeat(14, -1).repeat(14, -2).astype(np.uint8)
    return np.tile(first, (1, 3, 1, 1)), mean, np.tile(other, (1, 3, 1, 1))


def test_a_policy_that_looks_at_one_place_peaks_there():
    inside = []
    for number in range(20):
        rng = np.random.default_rng(number)
        stream = int(rng.integers(V))
        row, column = rng.integers(0, SIDE - 12, 2)
        views, means, other = pictures(rng)
        found = covered(PlacePolicy(stream, (row, column)), views, np.zeros(2), MASK, means, other)
        peak = np.argwhere(found.distance == found.distance.max())
        middle = peak[:, 1:].mean(0)
        near = np.abs(middle - [row + 6, column + 6]).max() <= SIDE / 8 + 6
        inside.append(bool(near and set(peak[:, 0]) == {stream} and found.found[stream]))
        assert found.found.sum() <= 1
    assert np.mean(inside) >= 0.95


def test_a_blind_policy_is_flat_within_its_control():
    views, means, other = pictures(np.random.default_rng(0))
    found = covered(PlacePolicy(), views, np.zeros(2), MASK, means, other)
    assert not found.found.any() and (found.distance <= found.level[:, None, None]).all()
    said = place_words(found, ["First person", "Third A", "Third B"])
    assert said.startswith("First person: nothing here (up to 0.00, control 0.02).")


def test_a_stream_that_is_absent_is_not_covered_and_has_nothing():
    views, means, other = pictures(np.random.default_rng(1))
    policy = PlacePolicy(1, (30, 30))
    mask = np.array([True, False, True])
    found = covered(policy, views, np.zeros(2), mask, means, other)
    assert not found.distance.any()
    whole = covered(policy, views, np.zeros(2), MASK, means, other)
    assert whole.peak[1] > 0.02 and not whole.distance[[0, 2]].any()


@pytest.mark.parametrize("place", [(0, 0), (72, 72)])
def test_corners_are_covered_too(place):
    views, means, other = pictures(np.random.default_rng(2))
    found = covered(PlacePolicy(2, place), views, np.zeros(2), MASK, means, other)
    assert found.distance[2, place[0] + 6, place[1] + 6] == pytest.approx(found.peak[2])


def test_a_task_without_an_expert_takes_the_mean_of_the_episode_and_says_so(monkeypatch):
    def fails(*_):
        raise NotImplementedError

    monkeypatch.setattr(attention, "mean_pictures", fails)
    runner = Runner()
    runner.adopt("p", PlacePolicy(2, (30, 30)))
    looks = [(pictures(np.random.default_rng(n))[0], np.zeros(2)) for n in range(3)]
    job = Job("p", PlacePolicy().spec.digest, Condition("all"), 60_000)
    html = attention.places_html(looks, 1, job, runner)
    runner.close()
    assert "The task has no expert" in html and "First person: nothing here" in html
    assert "data:image/jpeg" in html and attention.places_html(looks, None, job, runner) == ""
