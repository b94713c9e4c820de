"""The benchmark of recordings: a small one, from films to memory."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.recordings import CAMERAS, BenchRecordingsConfig, bench_recordings, made_up


def test_the_made_up_robot_moves_and_its_pictures_show_it() -> None:
    first, *_, last = made_up(np.random.default_rng(0), steps=5, size=(48, 64))
    assert list(first.pictures) == list(CAMERAS)
    assert all(picture.shape == (48, 64, 3) for picture in first.pictures.values())
    assert all((first.pictures[name] != last.pictures[name]).any() for name in CAMERAS)
    assert (first.state != last.state).any() and np.abs(last.action).max() < 1


@pytest.mark.slow
def test_a_small_benchmark_has_every_number() -> None:
    small = BenchRecordingsConfig(episodes=4, steps=8, height=48, width=64, rounds=2, updates=2)
    found = bench_recordings(small)
    assert found["frames_per_s"] > 0 and found["round_s"] > 0
    assert 100 < found["memory_mb"] < 4000
