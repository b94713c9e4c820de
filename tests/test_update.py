"""The learner around the formulas: its state, acting, precision, and the benchmark."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import update as bench
from benchmarks.update import STREAMS, BenchUpdateConfig, bench_update, contiguous, random_batch
from madviz.agent import update
from madviz.agent.agent import Agent
from madviz.agent.augment import draw_shifts
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.update import Learner, LearningConfig

NETWORKS = NetworkConfig(state_dim=5, action_dim=2, hidden_dim=16)
BATCH = random_batch(4, 3, NETWORKS)


def make(seed: int = 0, **config: Any) -> Learner:
    torch.manual_seed(0)
    learning = LearningConfig(**{"precision": "float32", **config})
    return Learner(Agent(NETWORKS), METHODS["mad"], STREAMS, learning, seed)


def weights(learner: Learner) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in learner.agent.parameters()])


def test_a_restored_learner_goes_on_exactly() -> None:
    one, two, file = make(), make(seed=9), io.BytesIO()
    one.update(BATCH)
    torch.save(one.state_dict(), file)
    one.update(BATCH)
    acted = one.act_all(BATCH.views[:1], BATCH.state[:1])
    file.seek(0)
    two.load_state_dict(torch.load(file, weights_only=True))
    assert not torch.equal(weights(one), weights(two))
    two.update(BATCH)
    assert torch.equal(weights(one), weights(two))
    np.testing.assert_array_equal(two.act_all(BATCH.views[:1], BATCH.state[:1]), acted)
    assert torch.equal(one.draw(4).actor_noise, two.draw(4).actor_noise)
    np.testing.assert_array_equal(one.draw(4).shifts, two.draw(4).shifts)


@pytest.mark.parametrize("same", [True, False])
def test_a_learner_draws_its_shifts_as_everybody_does(same: bool) -> None:
    found = make(seed=5, same_shift_for_views=same).draw(4).shifts
    expected = draw_shifts(np.random.default_rng(5), (2, 4, len(STREAMS)), same)
    np.testing.assert_array_equal(found, expected)


def test_a_restored_generator_draws_what_the_saved_one_draws() -> None:
    rng, again, file = np.random.default_rng(5), np.random.default_rng(6), io.BytesIO()
    rng.integers(0, 2, 3, np.uint8)  # Leaves half a draw over.
    torch.save({"rng": update.generator_state(rng)}, file)
    file.seek(0)
    update.restore_generator(again, torch.load(file, weights_only=True)["rng"])
    assert again.integers(0, 2**31, 20).tolist() == rng.integers(0, 2**31, 20).tolist()


def test_the_memory_layout_of_a_batch_changes_nothing() -> None:
    one, two = make(), make()
    one.update(BATCH)
    two.update(contiguous(BATCH))
    assert BATCH.views.stride() != contiguous(BATCH).views.stride()
    torch.testing.assert_close(weights(one), weights(two))


def test_acting_draws_from_the_policy_on_all_streams() -> None:
    learner = make()
    drawn = np.concatenate([learner.act_all(BATCH.views[:1], BATCH.state[:1]) for _ in range(300)])
    assert drawn.shape == (300, 2) and drawn.dtype == np.float32 and (np.abs(drawn) <= 1).all()
    with torch.no_grad():
        merged = learner.agent.encoder.encode(BATCH.views[:1]).sum(1)
        mean, log_std = learner.agent.actor(merged, BATCH.state[:1])
    before_tanh = np.arctanh(drawn.astype(np.float64))
    error, spread = before_tanh.mean(0) - mean[0].numpy(), log_std.exp()[0].numpy()
    assert (np.abs(error) < 4 * spread / np.sqrt(300)).all()
    np.testing.assert_allclose(before_tanh.std(0), spread, rtol=0.2)


def test_the_positive_view_of_mvd_is_any() -> None:
    agent = Agent(NETWORKS, merge="mvd", streams=STREAMS)
    learner = Learner(agent, METHODS["mvd"], STREAMS, LearningConfig(precision="float32"), 0)
    drawn = [learner.draw(1).own_loss for _ in range(60)]
    counts = np.bincount([one[1] for one in drawn if one is not None], minlength=3)
    assert counts.sum() == 60 and (counts > 8).all()


def test_precision_is_chosen_by_the_cpu_unless_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for has, expected in ((True, True), (False, False)):
        monkeypatch.setattr(update, "fast_bfloat16", lambda has=has: has)
        assert make(precision="auto").low_precision is expected
        assert make(precision="bfloat16").low_precision
        assert not make(precision="float32").low_precision


def test_learning_lowers_the_critics_error() -> None:
    """The critic can only fit rewards here: nothing is bootstrapped."""
    learner = make(learning_rate=3e-3)
    BATCH.discount.zero_()
    losses = [learner.update(BATCH)["critic_loss"] for _ in range(40)]
    BATCH.discount.fill_(0.99)
    assert losses[-1] < 0.3 * losses[0]


def test_the_benchmark_reports_medians_and_how_often_ours_fits_into_the_naive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, updated = iter([10.0, 40.0, 90.0, 50.0, 20.0, 80.0]), []

    def milliseconds(work: Callable[[], object]) -> float:
        updated.append(work())
        return next(clock)

    monkeypatch.setattr(bench, "_milliseconds", milliseconds)
    found = bench_update(BenchUpdateConfig(rounds=3, batch_size=4, hidden_dim=8, threads=1))
    assert (found["ours_ms"], found["naive_ms"], found["ratio"]) == (20, 50, 2.5)
    assert found["raw"] == {"ours_ms": [10, 90, 20], "naive_ms": [40, 50, 80]}
    assert found["peak_mb"] > 50 and found["threads"] == 1
    losses = [one["critic_loss"] for one in updated]
    assert len(losses) == 6 and len(set(losses)) == 6, "an update of each in turn"
