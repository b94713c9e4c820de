"""Saliency: the true slope of the true number, in every merge, and no more often than asked."""

from __future__ import annotations

import copy
import threading
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.merges.vib import VibOptions
from madviz.agent.networks import Encoder, NetworkConfig, Trunk
from madviz.analysis import saliency as module
from madviz.analysis.saliency import LiveSaliency, saliency
from madviz.errors import UserError
from madviz.guard.policy import GuardedPolicy
from madviz.types import PolicySpec
from tests.fakes import FakePolicy

STREAMS = ("first", "third_a", "third_b")
NETWORKS = NetworkConfig(state_dim=6, action_dim=3, hidden_dim=16, own=VibOptions(8))
ALL = np.ones(3, bool)
STATE = np.linspace(-1, 1, 6).astype(np.float32)


@cache
def policy_with(merge: str = "sum") -> TorchPolicy:
    spec = PolicySpec("p", "toy/reach", "mad", "three", "light", STREAMS, ("all", *STREAMS))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        agent = Agent(NETWORKS, merge=merge, streams=STREAMS)
        for weight in agent.critic.parameters():
            if weight.ndim > 1 and not weight.any():  # MV-MWM's value is 0 until it is trained.
                torch.nn.init.normal_(weight, std=0.1)
        return TorchPolicy(spec, agent)


def pictures(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (3, 9, 84, 84), np.uint8)


def test_the_encoder_reads_floating_pixels_as_it_reads_bytes() -> None:
    encoder, pixels = Encoder(3), torch.from_numpy(pictures())
    torch.testing.assert_close(encoder(pixels.float()), encoder(pixels), rtol=0, atol=0)
    slow = encoder.double()
    torch.testing.assert_close(slow(pixels.double()), slow(pixels), rtol=0, atol=1e-12)


def test_a_guard_changes_nothing_of_a_map() -> None:
    values: Any = SimpleNamespace(streams=dict.fromkeys(STREAMS), digest="")
    policy, mask = policy_with(), np.array([True, False, True])
    bare = saliency(policy, pictures(), STATE, mask)
    guarded = saliency(GuardedPolicy(policy, values), pictures(), STATE, mask)
    assert bare is not None and guarded is not None
    np.testing.assert_array_equal(bare, guarded)


@pytest.mark.parametrize("target", ["q", "action"])
def test_the_number_explained_is_the_one_the_policy_gives(target) -> None:
    policy, views = policy_with(), pictures()
    mask = np.array([True, False, True])
    readout = policy.read(policy.encode(views, STATE), mask[None])
    pixels = torch.from_numpy(views)[None]
    number = module._number(policy.agent, pixels, STATE, mask, target)
    expected = readout.q[0] if target == "q" else np.linalg.norm(readout.action[0])
    assert number(pixels.float()).item() == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("merge", MERGES)
def test_every_merge_has_maps_in_bounds(merge: str) -> None:
    maps = saliency(policy_with(merge), pictures(), STATE, ALL)
    assert maps is not None and maps.dtype == np.float32
    assert maps.shape == (3, 84, 84)
    assert maps.min() >= 0 and maps.max() == 1


def test_a_stream_that_is_not_present_is_not_looked_at() -> None:
    maps = saliency(policy_with(), pictures(), STATE, np.array([True, False, True]))
    assert maps is not None
    assert maps[1].max() == 0 and maps[0].max() > 0 and maps[2].max() > 0


def test_maps_find_the_pixels_that_matter() -> None:
    """Weights that see the upper left corner of the view alone: nothing else may light up."""
    policy = copy.deepcopy(policy_with())
    first = torch.zeros(1, 3136)
    first[0, ::49] = 1.0  # The place in row 0, column 0 of every one of the 64 maps.
    with torch.no_grad():
        for head in (policy.agent.actor, policy.agent.critic):
            trunk = head.trunk
            assert isinstance(trunk, Trunk)
            trunk.linear.weight *= first
    maps = saliency(policy, pictures(), STATE, ALL, "q")
    assert maps is not None
    # One place of the last layer sees 36 x 36 pixels: 8, 3 more steps of 4, 2 more steps of 8.
    assert maps[:, 36:].max() == 0 and maps[:, :, 36:].max() == 0
    assert maps[:, :36, :36].max() == 1


def test_the_same_input_has_the_same_map_and_chance_is_left_alone() -> None:
    policy, views = policy_with(), pictures()
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    first, second = (saliency(policy, views, STATE, ALL) for _ in range(2))
    assert first is not None and second is not None
    np.testing.assert_array_equal(first, second)
    assert torch.equal(before, torch.random.get_rng_state())
    assert all(weights.grad is None for weights in policy.agent.parameters())


def test_no_map_without_torch_or_where_it_cannot_act() -> None:
    assert saliency(FakePolicy(), pictures(), STATE, ALL) is None
    assert saliency(policy_with("concat"), pictures(), STATE, ALL) is not None
    assert saliency(policy_with("concat"), pictures(), STATE, ALL & (np.arange(3) > 0)) is None
    with pytest.raises(UserError, match="unknown saliency target"):
        saliency(policy_with(), pictures(), STATE, ALL, "reward")  # type: ignore[arg-type]


def asked() -> LiveSaliency:
    """One that has loaded what it needs."""
    live, loaded = LiveSaliency(), threading.Event()
    live.ask("q", loaded.set)
    assert loaded.wait(60)
    return live


def test_nothing_is_due_before_somebody_asks() -> None:
    live = LiveSaliency()
    assert not live.due("now", ALL, 0.0, moving=False, full_speed=False)
    with pytest.raises(UserError, match="ask for q or action"):
        live.update(policy_with(), pictures(), STATE, ALL, "now", 0.0)


def test_maps_come_twice_a_second_at_once_when_paused_and_never_at_full_speed() -> None:
    live, policy = asked(), policy_with()
    assert live.due("a", ALL, 10.0, moving=True, full_speed=False)
    live.update(policy, pictures(), STATE, ALL, "a", 10.0)
    assert live.maps is not None and list(live.maps) == list(STREAMS)
    assert not live.due("b", ALL, 10.3, moving=True, full_speed=False)
    assert live.due("b", ALL, 10.5, moving=True, full_speed=False)
    assert live.due("b", ALL, 10.1, moving=False, full_speed=False), (
        "paused, nothing else is waiting"
    )
    assert not live.due("a", ALL, 99.0, moving=False, full_speed=False), "it has been looked at"
    assert not live.due("b", ALL, 99.0, moving=True, full_speed=True)
    assert live.maps is None, "an old map on new pictures would be wrong"


def test_dropping_a_stream_is_another_instant_though_nothing_was_encoded() -> None:
    live, less = asked(), ALL & (np.arange(3) > 0)
    live.update(policy_with(), pictures(), STATE, ALL, "a", 0.0)
    assert live.due("a", less, 0.0, moving=False, full_speed=False)
    assert not live.due("a", less, 0.1, moving=True, full_speed=False)


def test_switching_off_takes_the_maps_away() -> None:
    live = asked()
    live.update(policy_with(), pictures(), STATE, ALL, "a", 0.0)
    live.ask(None, lambda: None)
    assert live.maps is None and not live.due("b", ALL, 9.0, moving=False, full_speed=False)


def test_another_episode_is_looked_at_without_waiting() -> None:
    live = asked()
    live.update(policy_with(), pictures(), STATE, ALL, "a", 10.0)
    live.forget()
    assert live.maps is None and live.due("b", ALL, 10.1, moving=True, full_speed=False)


def test_asking_for_the_same_again_keeps_what_there_is() -> None:
    """What was loaded in the background asks again, and must not take a first map away."""
    live = asked()
    live.update(policy_with(), pictures(), STATE, ALL, "a", 0.0)
    maps = live.maps
    live.ask("q", lambda: None)
    assert live.maps is maps is not None
    live.ask("action", lambda: None)
    assert live.maps is None and live.due("a", ALL, 9.0, moving=True, full_speed=False)


def test_a_policy_without_torch_leaves_no_maps() -> None:
    live = asked()
    live.update(FakePolicy(), pictures(), STATE, ALL, "a", 0.0)
    assert live.maps is None
    assert not live.due("a", ALL, 9.0, moving=False, full_speed=False), (
        "asking again would not help"
    )
