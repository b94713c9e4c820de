"""What runs on a CUDA device alone; elsewhere there is nothing to test, and it is skipped."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.update import STREAMS, random_batch
from madviz.agent.agent import Agent
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.objectives import Batch
from madviz.agent.update import Learner, LearningConfig
from madviz.agent.update_graph import WARM_UP
from madviz.policies.checkpoint import load_policy
from madviz.runs import reward_run
from madviz.runs.buffer import BufferSpec, ReplayBuffer
from madviz.training.config import TrainConfig
from madviz.training.vectorised import VectorisedConfig
from tests.recipe_runs import last_state, stops_at

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")

NETWORKS = NetworkConfig(state_dim=5, action_dim=2, hidden_dim=16, state_columns=(4, 0, 1))
BATCHES = random_batch(6 * (WARM_UP + 3), 3, NETWORKS)
LEARNING = LearningConfig(precision="float32")
GRAPHED = sorted(
    name
    for name, method in METHODS.items()
    if "paper-vectorised" in method.recipes and name != "mvd"  # A loss of its own: no graph.
)


def learner(method: str, device: str = "cuda", graph: bool = True) -> Learner:
    torch.manual_seed(0)
    streams = STREAMS[:1] if method.startswith("single") else STREAMS
    agent = Agent(NETWORKS, merge=METHODS[method].merge, streams=streams).to(device)
    made = Learner(agent, METHODS[method], streams, LEARNING, seed=0)
    if not graph:
        made._graph = None
    return made


def weights(made: Learner) -> torch.Tensor:
    return torch.cat([p.detach().flatten().cpu() for p in made.agent.parameters()])


def batch(number: int, streams: int = 3) -> Batch:
    """Six transitions that no other ``number`` has; ``streams``: the first ones alone."""
    rows = slice(6 * number, 6 * number + 6)
    taken = {name: column[rows] for name, column in vars(BATCHES).items()}
    views = {name: taken[name][:, :streams] for name in ("views", "next_views")}
    return Batch(**taken | views)


def saved(made: Learner) -> dict[str, Any]:
    """Its state from a file, as a resumed run has it: without that, optimisers would share it."""
    file = io.BytesIO()
    torch.save(made.state_dict(), file)
    file.seek(0)
    return torch.load(file, "cpu", weights_only=True)


@pytest.mark.parametrize("method", GRAPHED)
def test_a_recorded_update_is_the_update(method: str) -> None:
    one, other = learner(method), learner(method, graph=False)
    began = weights(one)
    for number in range(WARM_UP + 3):
        met = batch(number, len(one._masks[0]))
        losses, expected = one.update(met), other.update(met)
        assert losses == pytest.approx(expected, rel=1e-2, abs=1e-3)
    moved, apart = (weights(one) - began).abs(), (weights(one) - weights(other)).abs()
    assert moved.max() > 1e-3 and apart.mean() < 0.02 * moved.mean()


def test_an_update_on_a_device_is_that_on_a_cpu() -> None:
    one, other = learner("mad"), learner("mad", "cpu")
    draw = one.draw(6)
    assert one.update(batch(0), draw) == pytest.approx(other.update(batch(0), draw), rel=1e-3)


def test_a_restored_learner_records_anew_and_goes_on() -> None:
    one, two = learner("mad"), learner("mad")
    for number in range(WARM_UP + 2):
        one.update(batch(number))
        two.update(batch(number + 1))
    began, apart = weights(one), (weights(one) - weights(two)).abs().mean()
    two.load_state_dict(saved(one))
    for number in range(WARM_UP + 2):
        one.update(batch(number))
        two.update(batch(number))
    moved, still = (weights(one) - began).abs().mean(), (weights(one) - weights(two)).abs().mean()
    assert still < 0.02 * moved and still < 0.1 * apart
    two.update(random_batch(3, 3, NETWORKS))  # Another size is no error.


def test_what_a_cpu_has_learned_goes_on_on_a_device() -> None:
    here, there = learner("mad", "cpu"), learner("mad")
    here.update(batch(0))
    there.load_state_dict(saved(here))
    for number in range(1, WARM_UP + 2):
        there.update(batch(number))


def test_a_ring_on_a_device_has_the_same_batches() -> None:
    spec = BufferSpec(
        ("a.rgb", "b.depth"), state_dim=2, action_dim=1, capacity=30, horizon=5, lanes=2
    )
    rings = [ReplayBuffer(spec), ReplayBuffer(spec, device="cuda")]
    rng = np.random.default_rng(0)
    for step in range(60):
        frames = [rng.integers(0, 255, (84, 84, c), np.uint8) for c in (3, 1)]
        for ring in rings:
            if (step // 2) % 6 == 0:
                ring.begin(np.zeros(2, np.float32), frames)
            else:
                ring.add(np.zeros(1, np.float32), 1.0, 0.9, np.zeros(2, np.float32), frames)
    here, there = (ring.sample(20, np.random.default_rng(1)) for ring in rings)
    for views in ("views", "next_views"):
        assert getattr(there, views).device.type == "cuda"
        assert torch.equal(getattr(here, views), getattr(there, views).cpu())


def test_a_run_on_a_device_stops_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reward_run, "PROGRESS_SECONDS", 0)
    config = VectorisedConfig(
        steps=120, exploration_steps=40, batch_size=8, hidden_dim=8, eval_every=50,
        eval_episodes=1, environments=2, workers=1,
    )  # fmt: skip
    begun = TrainConfig(
        "toy/reach", "mad", "paper-vectorised", out=tmp_path / "run", seed=3, threads=1,
        vectorised=config,
    )  # fmt: skip
    state = last_state(begun, stops_at(66))
    assert (state["step"], state["updates"]) == (66, 12)
    state = last_state(replace(begun, resume=True))
    assert (state["step"], state["updates"]) == (120, 39)
    assert load_policy(tmp_path / "run").spec.method == "mad"
    trained = json.loads((tmp_path / "run" / "config.json").read_text())["training"]
    assert trained["device"] == torch.cuda.get_device_name()
