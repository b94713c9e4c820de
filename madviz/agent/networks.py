"""MAD's networks: one shared CNN, and per head a small trunk in front of an MLP (paper, appendix).

    uint8 (9, 84, 84) --Encoder--> 3136 --sum over streams--> Trunk 50 --> Actor / twin Critic

Two decisions make the encoder fast on a CPU. Memory is ``channels_last``, so oneDNN convolves
without reordering. And pixels are centred while they are still bytes: flipping the top bit of a
uint8 and reading it as int8 is x - 128, which bfloat16 holds exactly. Scale and the missing half
move into the first convolution, so that the result equals the paper's x / 255 - 0.5:

    w * (x / 255 - 0.5) + b  =  (w / 255) * (x - 128) + b + 0.5 sum(w / 255)
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.sizes import FEATURE_MAP as FEATURE_MAP
from madviz.agent.sizes import FEATURE_SIZE as FEATURE_SIZE
from madviz.agent.sizes import FURTHEST
from madviz.agent.sizes import NetworkConfig as NetworkConfig


class Encoder(nn.Module):
    """The shared CNN f: 84 -> 20 -> 9 -> 7 pixels, no padding, no normalisation; 88,224 weights."""

    def __init__(self, frame_stack: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3 * frame_stack, 32, 8, stride=4)
        self.conv2 = nn.Conv2d(32, 64, 4, stride=2)
        self.conv3 = nn.Conv2d(64, 64, 3, stride=1)
        for conv in (self.conv1, self.conv2, self.conv3):
            nn.init.orthogonal_(conv.weight, nn.init.calculate_gain("relu"))
            assert conv.bias is not None
            nn.init.zeros_(conv.bias)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, pixels: Tensor) -> Tensor:
        """(B, C, H, W) uint8 -> (B, Z) non-negative features. Pixels may also be int8, which are
        centred already, or floating, 0 to 255: bytes have no gradient, and saliency asks for
        one."""
        low = torch.is_autocast_enabled(pixels.device.type)
        x = pixels.contiguous(memory_format=torch.channels_last)
        if x.is_floating_point():
            x = x - 128
        elif x.dtype == torch.uint8:
            x = (x ^ 128).view(torch.int8)
        x = x.to(torch.bfloat16 if low else self.conv1.weight.dtype)
        weight = self.conv1.weight / 255
        assert self.conv1.bias is not None
        x = F.conv2d(x, weight, self.conv1.bias + 0.5 * weight.sum((1, 2, 3)), stride=4)
        x = F.relu(self.conv2(F.relu(x, inplace=True)), inplace=True)
        return F.relu(self.conv3(x), inplace=True).flatten(1)


class Trunk(nn.Module):
    """Z -> 50: where a head first sees a merged or singular feature. LayerNorm comes after the
    linear layer, so the number of views in a sum still shows in its input."""

    def __init__(self, config: NetworkConfig, width: int = FEATURE_SIZE) -> None:
        super().__init__()
        self.linear = nn.Linear(width, config.feature_dim)
        self.norm = nn.LayerNorm(config.feature_dim)

    def forward(self, feature: Tensor) -> Tensor:
        return torch.tanh(self.norm(self.linear(feature)))


def read_state(config: NetworkConfig, state: Tensor) -> Tensor:
    """(..., S) -> (..., state_inputs): the numbers that the heads read of a state. As they are in
    the paper; with speeds, and in units of their spread, where ``config`` says so."""
    read = _columns(state, config.state_columns) if config.state_columns else state
    if config.state_changes:
        now, before = zip(*config.state_changes, strict=True)
        read = torch.cat([read, _columns(state, now) - _columns(state, before)], -1)
    if config.state_mean:
        mean = read.new_tensor(config.state_mean)
        spread = read.new_tensor(config.state_spread)
        read = ((read - mean) / spread).clamp(-FURTHEST, FURTHEST)
    return read


def _columns(state: Tensor, columns: tuple[int, ...]) -> Tensor:
    """``state[..., columns]``; on a GPU without copying the numbers there, which a CUDA graph
    could not repeat."""
    if state.device.type == "cpu":
        return state[..., list(columns)]
    return torch.stack([state[..., column] for column in columns], -1)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.ReLU(),
        nn.Linear(hidden, outputs),
    )


def _read(mlp: nn.Sequential, x: Tensor) -> Tensor:
    """The last layer is small and its output is compared: a Q of 500 in bfloat16 would move in
    steps of 2. It runs in the weights' own precision whatever autocast says."""
    hidden = mlp[:-1](x)
    last = mlp[-1]
    with torch.autocast(x.device.type, enabled=False):
        return last(hidden.to(last.weight.dtype))


def orthogonal(module: nn.Module) -> None:
    """The paper's start of every linear layer in ``module``: orthogonal weights, zero biases."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


def _trunk(config: NetworkConfig, width: int, projected: bool) -> tuple[nn.Module, int]:
    """The module in front of a head's MLP, and how many numbers come out of it."""
    if projected:
        return Trunk(config, width), config.feature_dim
    return nn.Identity(), width


class ActorHead(nn.Module):
    """Acts on the rows of a merge: feature and state to a tanh-Gaussian over actions."""

    def forward(self, feature: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """(..., Z), (..., S) -> mean and log standard deviation before tanh, (..., A) each."""
        raise NotImplementedError


class CriticHead(nn.Module):
    """Judges actions on the rows of a merge: twin Q behind one trunk."""

    trunk: Callable[[Tensor], Tensor]

    def heads(self, hidden: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The part behind the trunk: a feature read for several actions is projected once."""
        raise NotImplementedError

    def forward(self, feature: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """(..., Z), (..., S), (..., A) -> Q1, Q2, (...,) each."""
        return self.heads(self.trunk(feature), state, action)


class Actor(ActorHead):
    """One trunk and one MLP."""

    def __init__(
        self, config: NetworkConfig, width: int = FEATURE_SIZE, projected: bool = True
    ) -> None:
        """Reads features of ``width`` numbers: through a trunk, or as they are if they come
        ``projected=False`` from an encoder that has done it."""
        super().__init__()
        self.config = config
        self.trunk, hidden = _trunk(config, width, projected)
        inputs = config.state_inputs + hidden
        self.mlp = _mlp(inputs, config.hidden_dim, 2 * config.action_dim)
        orthogonal(self)

    def inputs(self, feature: Tensor, state: Tensor) -> Tensor:
        """(..., Z), (..., S) -> (..., K), what the MLP reads."""
        return torch.cat([read_state(self.config, state), self.trunk(feature)], -1)

    def forward(self, feature: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        output = _read(self.mlp, self.inputs(feature, state))
        mean, raw = output.chunk(2, -1)
        low, high = self.config.log_std_bounds
        return mean, low + 0.5 * (high - low) * (torch.tanh(raw) + 1)


def squash(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """tanh(mean + std * noise) and its log-probability, stable where tanh saturates.

    log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)).
    """
    x = mean + log_std.exp() * noise
    gaussian = -0.5 * noise.square() - log_std - 0.5 * torch.log(torch.tensor(2 * torch.pi))
    correction = 2 * (torch.log(torch.tensor(2.0)) - x - F.softplus(-2 * x))
    return torch.tanh(x), (gaussian - correction).sum(-1)


class Critic(CriticHead):
    """Twin Q with one trunk between them."""

    def __init__(
        self, config: NetworkConfig, width: int = FEATURE_SIZE, projected: bool = True
    ) -> None:
        """``width`` and ``projected`` as the actor's."""
        super().__init__()
        self.config = config
        self.trunk, hidden = _trunk(config, width, projected)
        inputs = hidden + config.action_dim + config.state_inputs
        self.q1 = _mlp(inputs, config.hidden_dim, 1)
        self.q2 = _mlp(inputs, config.hidden_dim, 1)
        orthogonal(self)

    def heads(self, hidden: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.cat([hidden, action, read_state(self.config, state)], -1)
        return _read(self.q1, x).squeeze(-1), _read(self.q2, x).squeeze(-1)
