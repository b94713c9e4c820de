"""VIB: third-person views pass a noisy bottleneck, the first-person view does not.

The idea (Hsu et al., as the paper's code has it): what a third-person camera adds must pay for its
bits. Its feature becomes a Gaussian per number, a sample of it goes on, and the distance of that
Gaussian to N(0, 1) is a cost next to the critic's loss:

    first     CNN_1 -> 3136 -------------------------------------------.
    third_a   CNN_2 -> Linear -> mean, log std -> mean + std * noise --+-> side by side -> trunk
    third_b   CNN_3 -> Linear -> mean, log std -> mean + std * noise --'
    cost      beta * mean of (mean^2 + std^2 - 1 - 2 log std) / 2

Every view has its own CNN. Each mean keeps its own log std here; the paper's code stacks them on
two different axes, so that with two third-person views they are paired wrongly. With all views at
hand the policy acts on the means. With one view alone, that view is put into every slot and seen by
each slot's own CNN, as in the paper's code. So VIB acts on all views or on one; on two of three it
has no rule, and says so.

The paper's Gaussian has 3136 numbers (19.7 million weights per view). The ``light`` recipe projects
to fewer before the bottleneck: 64 by default.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.merges.base import Heads, Merge, Noise, Streams, wide_heads
from madviz.agent.networks import FEATURE_SIZE, Encoder, NetworkConfig, orthogonal
from madviz.agent.sizes import OwnOptions
from madviz.subsets import camera_of
from madviz.system.numbers import Weight, Width

FIRST = "first"
"""The camera without a bottleneck."""


def third_person(streams: Streams) -> list[int]:
    """Which streams pass the bottleneck: those of every camera but ``first``."""
    return [i for i, name in enumerate(streams) if camera_of(name) != FIRST]


@dataclass(frozen=True)
class VibOptions(OwnOptions):
    """VIB's own options; the defaults are the paper's."""

    bottleneck_dim: Width = FEATURE_SIZE
    """Numbers in the Gaussian of a third-person view (the paper has 3136, ``light`` 64)."""
    kl_weight: Weight = 10.0
    """Beta, the weight of the bottleneck's cost, a mean over its numbers (``light``: 0.01): 10 /
    3136 for every nat of a view's Gaussian."""

    @classmethod
    def of_recipe(cls, recipe: str) -> OwnOptions:
        """Errors of actions, which ``light`` minimises, are about a thousandth of the squared
        errors of Q that the paper's 10 stands beside."""
        return cls(64, 0.01) if recipe == "light" else cls()


class BottleneckEncoder(Merge):
    """A CNN per stream, and a Gaussian's two linear maps for every third-person one."""

    def __init__(self, config: NetworkConfig, streams: Streams) -> None:
        super().__init__(config, streams)
        options = config.own_as(VibOptions)
        self.third = third_person(streams)
        self.first = [i for i in range(len(streams)) if i not in self.third]
        self.latent = options.bottleneck_dim
        self.kl_weight = options.kl_weight
        self.cnns = nn.ModuleList(Encoder(config.frame_stack) for _ in streams)
        self.gaussians = nn.ModuleDict(
            {str(i): nn.Linear(FEATURE_SIZE, 2 * self.latent) for i in self.third}
        )
        orthogonal(self)

    def heads(self, config: NetworkConfig) -> Heads:
        width = len(self.third) * self.latent + len(self.first) * FEATURE_SIZE
        return wide_heads(config, width)  # 9408 for the paper's three views

    def slot(self, index: int, pixels: Tensor) -> Tensor:
        """(B, C, H, W) seen by slot ``index`` -> (B, D): mean and log std, or a feature; D is the
        wider of both, the rest is 0."""
        feature = self.cnns[index](pixels)
        if index in self.third:
            feature = self.gaussians[str(index)](feature)
        return F.pad(feature, (0, max(2 * self.latent, FEATURE_SIZE) - feature.shape[-1]))

    def encode(self, views: Tensor) -> Tensor:
        """(B, V, C, H, W) -> (B, V, D): every view in its own slot, as in training."""
        return torch.stack([self.slot(i, views[:, i]) for i in range(len(self.cnns))], 1)

    def encode_to_act(self, views: Tensor) -> Tensor:
        """(B, V, C, H, W) -> (B, V slots, V views, D), so that any view can stand in for all."""
        pixels = views.flatten(0, 1)
        batch = views.shape[:2]
        slots = [self.slot(i, pixels).unflatten(0, batch) for i in range(len(self.cnns))]
        return torch.stack(slots, 1)

    def gaussian(self, own: Tensor) -> tuple[Tensor, Tensor]:
        """(B, V, D) -> means and log stds of the third-person views, (B, T, latent) each."""
        third = torch.stack([own[:, index] for index in self.third], 1)
        return third[..., : self.latent], third[..., self.latent : 2 * self.latent]

    def represent(self, own: Tensor, noise: Tensor | None) -> Tensor:
        """(B, V, D), (B, T, latent) or None for the means -> (B, width)."""
        mean, log_std = self.gaussian(own)  # (B, T, latent) each
        sample = mean
        if noise is not None:
            sample = mean + log_std.exp() * noise.to(own.device, own.dtype)
        first = own[:, self.first, :FEATURE_SIZE]
        return torch.cat([sample.flatten(1), first.flatten(1)], -1)

    def rows(self, features: Tensor, masks: Tensor, noise: Noise = None) -> Tensor:
        """(B, V, D) of ``encode`` or (B, V, V, D) of ``encode_to_act``, masks (N, V) of all or one
        -> (N, B, width)."""
        if features.dim() == 3:
            return self.represent(features, noise).expand(len(masks), -1, -1)
        diagonal = torch.diagonal(features, dim1=1, dim2=2).transpose(1, 2)
        rows = []
        for mask in masks.bool():
            own = diagonal if bool(mask.all()) else features[:, :, int(mask.int().argmax())]
            rows.append(self.represent(own, noise))
        return torch.stack(rows)

    def feature_of_each(self, features: Tensor) -> Tensor:
        """(B, V, V, D) -> (B, V, Z): every view's means or feature in its own slot, the rest 0."""
        own = torch.diagonal(features, dim1=1, dim2=2).transpose(1, 2).clone()
        own[:, self.third, self.latent :] = 0
        return own[..., : max(self.latent, FEATURE_SIZE)]

    def noise(self, batch: int, generator: torch.Generator) -> Tensor:
        """(B, T, latent) standard normal; the first-person streams need none."""
        return torch.randn(batch, len(self.third), self.latent, generator=generator)

    def penalty(self, features: Tensor) -> Tensor:
        return self.kl_weight * kl_loss(*self.gaussian(features))


def kl_loss(mean: Tensor, log_std: Tensor) -> Tensor:
    """KL from N(mean, std) to N(0, 1), averaged over samples, views and dimensions.

    KL of one number: (mean^2 + std^2 - 1) / 2 - log std. Single precision at least.
    """
    if mean.dtype == torch.bfloat16:
        mean = mean.float()
        log_std = log_std.float()
    return (0.5 * (mean.square() + (2 * log_std).exp() - 1) - log_std).mean()
