"""``benchmarks buffer`` on the toy, small enough to be a test; times are not judged."""

from __future__ import annotations

import json

import pytest

from benchmarks import buffer as module
from benchmarks.buffer import BenchBufferConfig, bench_buffer
from madviz.errors import UserError
from madviz.runs import buffer_storage


def test_both_sides_are_measured_on_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffer_storage, "TOGETHER", 32)
    monkeypatch.setattr(module, "TOGETHER", 32)
    config = BenchBufferConfig(task="toy/reach", decisions=50, batch_size=3, rounds=1, fill=90)
    result = bench_buffer(config)
    json.dumps(result)
    assert result["instants"] == 52 and result["streams"] == ["first", "third_a", "third_b"]
    # 26 time steps for 25 transitions of three 84 x 84 x 3 frames and 45 bytes of numbers.
    plain = result["plain"]
    assert plain["bytes_per_transition"] == round((3 * 84 * 84 * 3 + 45) * 26 / 25)
    assert plain["gb_at_500k"] == pytest.approx(33.05, abs=0.01)
    assert result["bytes_per_transition"] < plain["bytes_per_transition"] / 2
    assert result["gb_at_500k"] < plain["gb_at_500k"] / 2
    assert result["times_smaller"] > 2 and result["sample_ms"] > 0 and result["add_per_s"] > 0
    assert result["filled"]["transitions"] >= 90 and result["filled"]["sample_ms"] > 0


def test_changed_frames_of_the_packed_buffer_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    original = buffer_storage.Pack.frames

    def wrong(pack: buffer_storage.Pack, places: list[int]) -> list[object]:
        return [frame ^ 1 for frame in original(pack, places)]

    monkeypatch.setattr(buffer_storage, "TOGETHER", 32)
    monkeypatch.setattr(module, "TOGETHER", 32)
    monkeypatch.setattr(buffer_storage.Pack, "frames", wrong)
    with pytest.raises(RuntimeError, match="came back changed"):
        bench_buffer(BenchBufferConfig(task="toy/reach", decisions=50, batch_size=3, rounds=1))


def test_too_few_decisions_are_refused() -> None:
    with pytest.raises(UserError, match="more than 1024 --decisions"):
        bench_buffer(BenchBufferConfig(task="toy/reach", decisions=1024))
