"""MV-MAE: its rows in float64, what learns from which loss, and what it imagines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.runs.demonstrations import Driver, record_episode
from madviz.runs.run_folder import RunFolder
from madviz.subsets import every_mask
from madviz.training import light, light_critic
from madviz.training.config import TrainConfig, command, resolve
from madviz.training.light import LightConfig, LightRun
from madviz.types import PolicySpec
from madviz.world_model.autoencoder import QUESTIONS, autoencoder_loss, newest
from madviz.world_model.mv_mae import TokenNetworks
from madviz.world_model.sizes import AutoencoderConfig, MvMaeOptions
from tests.plans import toy_plan
from tests.test_merges import layer_norm, linear, perturb, pictures, softmax, weights

STREAMS = SETTINGS["three"].streams
SMALL = AutoencoderConfig(width=16, layers=1, decoder_layers=1, heads=2)
NETWORKS = NetworkConfig(6, 2, hidden_dim=8, own=MvMaeOptions(SMALL, 3))
LIGHT = LightConfig(
    rounds=2, demonstrations=2, episodes_per_round=1, updates_per_round=2, batch_size=5, shift=0,
    hidden_dim=8, critic_updates=3,
)  # fmt: skip


def make(end_to_end: bool = False) -> Agent:
    torch.manual_seed(0)
    networks = replace(NETWORKS, own=MvMaeOptions(SMALL, 3, end_to_end))
    agent = Agent(networks, merge="mv-mae", streams=STREAMS)
    perturb(agent, 0.05)
    return agent


def net_of(agent: Agent) -> TokenNetworks:
    assert isinstance(agent.encoder, TokenNetworks)
    return agent.encoder


def run_of(folder: Path, end_to_end: bool = False) -> LightRun:
    plan = toy_plan("mv-mae")
    networks = replace(plan.networks, own=MvMaeOptions(SMALL, 3, end_to_end))
    run = LightRun(replace(plan, networks=networks), LIGHT, folder)
    run.add([record_episode(ToyReach(), STREAMS, Driver(), seed) for seed in range(2)], 0, [])
    return run


def policy_of(agent: Agent) -> TorchPolicy:
    spec = PolicySpec("p", "toy/reach", "mv-mae", "three", "light", STREAMS, ("all",))
    return TorchPolicy(spec, agent)


def read(w: dict, tokens: np.ndarray) -> np.ndarray:
    """(K, W) tokens through one transformer layer and the questions, head by head."""
    layer, width, half = "autoencoder.encoder.layers.0", 16, 8

    def attended(query: np.ndarray, key: np.ndarray, value: np.ndarray, heads: int) -> np.ndarray:
        size = width // heads
        parts = [slice(size * h, size * (h + 1)) for h in range(heads)]
        answers = [
            np.concatenate([softmax(key[:, h] @ q[h] / size**0.5) @ value[:, h] for h in parts])
            for q in query
        ]
        return np.stack(answers)

    seen = np.stack([layer_norm(w, f"{layer}.norm1", t) for t in tokens])
    inner, bias = w[f"{layer}.self_attn.in_proj_weight"], w[f"{layer}.self_attn.in_proj_bias"]
    query, key, value = np.split(seen @ inner.T + bias, 3, axis=1)
    answers = attended(query, key, value, heads=width // half)
    x = tokens + np.stack([linear(w, f"{layer}.self_attn.out_proj", a) for a in answers])
    for i, token in enumerate(x.copy()):
        wide = torch.from_numpy(
            linear(w, f"{layer}.linear1", layer_norm(w, f"{layer}.norm2", token))
        )
        x[i] += linear(w, f"{layer}.linear2", torch.nn.functional.gelu(wide).numpy())
    x = np.stack([layer_norm(w, "autoencoder.norm", token) for token in x])
    key, value = (
        np.stack([linear(w, f"reader.{part}", token) for token in x]) for part in ("key", "value")
    )
    return attended(w["reader.questions"], key, value, heads=4)


def test_rows_are_the_formula_for_every_subset() -> None:
    agent = make().double().eval()
    features = agent.encoder.encode(pictures())
    assert features.shape == (2, 3, 36, 16)
    masks = every_mask(3)[:-1]
    rows, w = agent.encoder.rows(features, torch.from_numpy(masks)), weights(agent.encoder)
    assert rows.shape == (7, 2, QUESTIONS * 16)
    for mask, row in zip(masks, rows, strict=True):
        tokens = features[1, torch.from_numpy(mask)].flatten(0, 1).detach().numpy()
        found, expected = row[1].detach().unflatten(0, (QUESTIONS, 16)).numpy(), read(w, tokens)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_the_pixels_of_an_absent_stream_change_nothing() -> None:
    agent, views, mask = make().eval(), pictures(), torch.tensor([[True, False, True]])
    other = views.clone()
    other[:, 1] = 255 - other[:, 1]
    one, two = (agent.encoder.encode_and_merge(v, mask)[1] for v in (views, other))
    assert torch.equal(one, two)
    net = net_of(agent)
    one, two = (net.imagined(net.encode(v), mask[0]) for v in (views, other))
    assert torch.equal(one, two) and one.shape == (2, 3, 3, 84, 84)


@pytest.mark.parametrize("end_to_end", [False, True])
def test_the_actors_loss_reaches_the_autoencoder_only_end_to_end(end_to_end: bool) -> None:
    agent = make(end_to_end)
    rows = agent.encoder.encode_and_merge(pictures(), torch.eye(3))[1]
    agent.actor(rows, torch.zeros(3, 2, 6))[0].square().sum().backward()
    net = net_of(agent)
    assert all(p.grad is not None for p in net.reader.parameters())
    reached = {name: p.grad is not None for name, p in net.autoencoder.named_parameters()}
    assert reached["stem.0.weight"] == reached["encoder.layers.0.linear1.weight"] == end_to_end
    assert reached["marks"] == end_to_end and not reached["pixels.weight"]


def test_a_light_update_is_imitation_and_reconstruction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_of(tmp_path)
    index = np.random.default_rng(run.plan.seed).integers(0, len(run.data), LIGHT.batch_size)
    views, net = run.data.views(index), net_of(run.agent)
    assert torch.equal(net.autoencoder.mean, newest(run.data.usual_views()).mean(0))
    generator = torch.Generator().manual_seed(run.plan.seed * 1_000_003)
    drawn = autoencoder_loss(
        net.autoencoder, views[:3], run.data.column("rewards", index[:3]), generator
    )
    rows = run.agent.encoder.encode_and_merge(views, run.masks)[1]
    mean, _ = run.agent.actor(rows, run.data.column("states", index).expand(4, -1, -1))
    errors = (torch.tanh(mean) - run.data.column("labels", index)).square().mean((1, 2))
    imitation = 0.5 * errors[0] + 0.5 * errors[1:].mean()
    losses: dict[str, float] = {}

    def step(name: str, loss: Tensor) -> None:
        losses[name] = loss.item()

    monkeypatch.setattr(run, "_step", step)
    monkeypatch.setattr(light, "autocast", lambda: torch.autocast("cpu", enabled=False))
    run.update()
    expected = {"optimiser": imitation.item(), "reconstruction": drawn.item()}
    assert losses == pytest.approx(expected, rel=1e-4)


def test_both_losses_move_what_is_theirs(tmp_path: Path) -> None:
    run = run_of(tmp_path)
    before = {name: p.detach().clone() for name, p in run.agent.named_parameters()}
    run.update()
    moved = {n for n, p in run.agent.named_parameters() if not torch.equal(p, before[n])}
    assert {"encoder.autoencoder.marks", "encoder.reader.questions"} <= moved
    assert any(name.startswith("actor") for name in moved)


def test_rows_that_are_kept_fit_the_same_critic(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In bfloat16 rows that stand elsewhere in a batch may be summed otherwise.
    monkeypatch.setattr(light_critic, "autocast", lambda: torch.autocast("cpu", enabled=False))
    losses, critics = [], []
    for kept in (True, False):
        monkeypatch.setitem(MERGES, "mv-mae", replace(MERGES["mv-mae"], costly_rows=kept))
        (tmp_path / str(kept)).mkdir()
        run = run_of(tmp_path / str(kept))
        fit = light_critic.fit_critic
        losses.append(fit(run.average, run.data, METHODS["mv-mae"], 0.5, 3, seed=0))
        critics.append(run.average.critic)
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    for one, two in zip(critics[0].parameters(), critics[1].parameters(), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4)


def test_a_policy_imagines_what_is_missing() -> None:
    agent = Agent(NETWORKS, merge="mv-mae", streams=STREAMS)
    mean = torch.rand(3, 3, 84, 84)
    net_of(agent).autoencoder.mean.copy_(mean)
    policy = policy_of(agent)
    encoded = policy.encode(pictures()[0].numpy(), np.zeros(6, np.float32))
    assert encoded.features.shape == (3, 36 * 16)
    found = policy.imagine(encoded, np.array([True, False, True]))
    expected = (255 * mean).round().byte().permute(0, 2, 3, 1).numpy()
    np.testing.assert_array_equal(found, expected)  # Nothing is learned: the mean.
    with pytest.raises(UserError, match="at least one stream of .*, found 'none'"):
        policy.imagine(encoded, np.zeros(3, bool))


def test_other_policies_imagine_nothing() -> None:
    policy = policy_of(Agent(NETWORKS))
    encoded = policy.encode(pictures()[0].numpy(), np.zeros(6, np.float32))
    with pytest.raises(UserError, match="expected a policy that draws pictures, found p"):
        policy.imagine(encoded, np.ones(3, bool))
    assert not policy.imagines


def test_a_saved_policy_imagines_as_before(tmp_path: Path) -> None:
    run = run_of(tmp_path)
    run.update()
    folder = RunFolder(tmp_path / "run", {}, False, lambda event: None)
    light._save(run, folder, final=False)
    policy = load_policy(folder.path)
    assert isinstance(policy, TorchPolicy) and policy.imagines
    assert not policy.spec.reads_together  # A page reads the subsets that it is asked for.
    views = run.data.views(np.array([9]))[0].numpy()
    mask = np.array([True, False, False])
    one, two = (
        each.imagine(each.encode(views, np.zeros(6, np.float32)), mask).astype(int)
        for each in (policy, policy_of(run.average))
    )
    assert abs(one - two).max() <= 1  # Half precision.


def test_the_command_says_the_sizes_that_were_chosen() -> None:
    small = MvMaeOptions(AutoencoderConfig(layers=2), end_to_end=True)
    config = TrainConfig("toy/reach", "mv-mae", own=small)
    assert command(config).endswith("--own.autoencoder.layers 2 --own.end-to-end")
    plan = resolve(config)
    assert plan.networks.own == small
    assert plan.spec.name == "toy-reach-mv-mae-light"
