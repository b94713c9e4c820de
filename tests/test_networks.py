"""Networks, merge and augmentation against what the paper says of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from madviz.agent.augment import _shift_by_index, draw_shifts, random_shift, shift
from madviz.agent.merges.sum import merge_sum
from madviz.agent.networks import Actor, Critic, Encoder, NetworkConfig, squash
from madviz.envs.registry import SETTINGS
from madviz.subsets import every_mask
from madviz.types import PolicySpec
from tests.fakes import random_policy

SMALL = NetworkConfig(hidden_dim=32)
STREAMS = SETTINGS["three"].streams
SPEC = PolicySpec("p", "toy/reach", "mad", "three", "light", STREAMS, ("all", *STREAMS))


def images(*shape: int) -> torch.Tensor:
    return torch.randint(
        0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )


def test_the_paper_counts_its_weights_so() -> None:
    def count(module: torch.nn.Module) -> int:
        return sum(p.numel() for p in module.parameters())

    config = NetworkConfig()
    assert count(Encoder(3)) == 88_224
    assert round(count(Actor(config)) / 1e6, 2) == 1.29
    assert round(count(Critic(config)) / 1e6, 2) == 2.42


def test_the_encoder_is_the_papers_formula() -> None:
    encoder, pixels = Encoder(3), images(4, 9, 84, 84)
    fast = encoder(pixels)
    slow = encoder.double()
    x = F.relu(slow.conv1(pixels.double() / 255 - 0.5))
    x = F.relu(slow.conv3(F.relu(slow.conv2(x)))).flatten(1)
    assert fast.shape == (4, 3136)
    assert torch.allclose(fast.double(), x, atol=1e-5)


def test_squash_is_the_density_of_a_squashed_gaussian() -> None:
    mean, log_std = torch.tensor([[0.3, -1.0]]), torch.tensor([[-0.5, 0.2]])
    noise = torch.tensor([[0.7, -0.4]])
    action, log_prob = squash(mean, log_std, noise)
    expected = 0.0
    for m, s, n in zip(mean[0].double(), log_std[0].double().exp(), noise[0].double(), strict=True):
        x = m + s * n
        density = math.exp(-0.5 * n**2) / (s * math.sqrt(2 * math.pi))
        expected += math.log(density / (1 - math.tanh(x) ** 2))
    assert action[0, 0] == pytest.approx(math.tanh(0.3 + math.exp(-0.5) * 0.7), abs=1e-6)
    assert log_prob.item() == pytest.approx(float(expected), abs=1e-4)


def test_squash_stays_finite_where_tanh_saturates() -> None:
    _, log_prob = squash(torch.full((1, 2), 50.0), torch.zeros(1, 2), torch.zeros(1, 2))
    assert torch.isfinite(log_prob).all()


def test_heads_read_the_chosen_state_numbers_alone() -> None:
    actor = Actor(NetworkConfig(hidden_dim=32, state_columns=(16, 17, 18, 19)))
    feature, state = torch.rand(2, 3136), torch.rand(2, 24)
    other = state.clone()
    other[:, :16] += 1
    assert torch.equal(actor(feature, state)[0], actor(feature, other)[0])
    other[:, 17] += 1
    assert not torch.equal(actor(feature, state)[0], actor(feature, other)[0])


def test_log_std_stays_within_its_bounds() -> None:
    actor = Actor(SMALL)
    _, log_std = actor(1e4 * torch.randn(64, 3136), torch.randn(64, 24))
    assert log_std.min() >= -10 and log_std.max() <= 2


def test_a_merge_is_the_sum_of_what_is_present() -> None:
    features = torch.randn(5, 3, 7)
    masks = torch.from_numpy(every_mask(3))
    merged = merge_sum(features, masks)
    assert merged.shape == (8, 5, 7)
    for mask, row in zip(masks, merged, strict=True):
        expected = sum((features[:, v] for v in range(3) if mask[v]), torch.zeros(5, 7))
        assert torch.allclose(row, expected, atol=1e-6)


def test_every_subset_in_one_pass_equals_one_at_a_time() -> None:
    policy = random_policy(SPEC, SMALL)
    encoded = policy.encode(images(3, 9, 84, 84).numpy(), np.zeros(24, np.float32))
    together = policy.read(encoded, every_mask(3))
    for index, mask in enumerate(every_mask(3)):
        alone = policy.read(encoded, mask)
        assert np.allclose(alone.action[0], together.action[index], atol=1e-5)
        assert np.allclose(alone.q[0], together.q[index], atol=1e-4)
        assert np.allclose(alone.merged[0], encoded.features[mask].sum(0), atol=1e-4)


def test_a_shift_moves_and_repeats_the_edge() -> None:
    picture = images(1, 1, 3, 84, 84)
    moved = shift(picture, np.array([[[3, -2]]]))
    padded = np.pad(picture[0, 0].numpy(), ((0, 0), (4, 4), (4, 4)), mode="edge")
    assert np.array_equal(moved[0, 0], padded[:, 4 + 3 : 4 + 3 + 84, 4 - 2 : 4 - 2 + 84])


def test_both_ways_to_shift_agree() -> None:
    pictures = images(6, 3, 9, 84, 84)
    shifts = np.random.default_rng(0).integers(-4, 5, (6, 3, 2))
    moved = shift(pictures, shifts)
    assert torch.equal(moved, _shift_by_index(pictures, torch.from_numpy(shifts)))


def test_pixels_centred_by_the_shift_give_the_same_features_to_the_bit() -> None:
    pictures, shifts = images(2, 1, 9, 84, 84), np.array([[[3, -2]], [[0, 4]]])
    moved, centred = shift(pictures, shifts), shift(pictures, shifts, centred=True)
    assert centred.dtype == torch.int8 and torch.equal(centred.int(), moved.int() - 128)
    encoder = Encoder(3)
    for low in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=low):
            assert torch.equal(encoder(centred[:, 0]), encoder(moved[:, 0]))


@pytest.mark.parametrize("same", [True, False])
def test_views_share_a_shift_or_do_not(same: bool) -> None:
    pictures = images(4, 1, 3, 84, 84).expand(4, 3, 3, 84, 84).contiguous()
    moved = random_shift(pictures, np.random.default_rng(0), same_for_views=same)
    alike = torch.equal(moved[:, 0], moved[:, 1]) and torch.equal(moved[:, 0], moved[:, 2])
    assert alike == same
    shifts = draw_shifts(np.random.default_rng(0), (4, 3), same)
    assert torch.equal(moved, shift(pictures, shifts)) and np.abs(shifts).max() <= 4
