"""A recurrent state-space model: what is believed of a world that is seen through pictures.

The problem: to imagine what actions lead to, one needs a state that can be advanced without
pictures, and that says how sure it is. The idea (Hafner et al., 2019 and 2021): a belief has a part
that is computed (*deterministic*) and a part that is drawn (*latent*), and the latent is predicted
before the picture comes (*prior*) and corrected by it (*posterior*):

    deterministic' = GRU(deterministic, latent, action)
    prior     p(latent' | deterministic')                without the picture: imagines
    posterior q(latent' | deterministic', embedding')    with it: observes

A latent is G choices with K values each, one-hot: with 16 x 16 it holds at most 16 log2 16 = 64
bits. A draw has no gradient, so the gradient of the probabilities is put in its place (straight
through): with probabilities (0.7, 0.3) and value 0 drawn, forward gives (1, 0), and a slope of
(2, 0) there reaches the logits as 0.7 x 0.3 x 2 = 0.42 and -0.42.

Prior and posterior are drawn to each other by KL(q || p), the prior faster than the posterior
(*balance*), and not at all below a few *free* nats: else the posterior would forget the picture to
please a prior that knows nothing yet.

Randomness is an argument everywhere. Without it the likeliest values are taken, for a policy that
must repeat itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.world_model.sizes import WorldModelConfig


@dataclass(frozen=True)
class Belief:
    """The belief at one time step, for B samples."""

    deterministic: Float[Tensor, "B M"]
    """The computed part."""
    latent: Float[Tensor, "B G K"]
    """The drawn part, one-hot; its gradient is that of the probabilities."""
    logits: Float[Tensor, "B G K"]
    """The logits of the distribution that ``latent`` was drawn from."""

    @property
    def feature(self) -> Float[Tensor, "B Z"]:
        """Both parts, as other networks read them."""
        return torch.cat([self.deterministic, self.latent.flatten(1)], 1)


def joined(beliefs: list[Belief]) -> Belief:
    """T beliefs of B samples each as one of T x B, time first."""
    parts = ("deterministic", "latent", "logits")
    return Belief(*(torch.cat([getattr(belief, part) for belief in beliefs]) for part in parts))


class Rssm(nn.Module):
    """See the module. An action that is not known is a vector of zeros, and is marked so."""

    def __init__(self, config: WorldModelConfig, embedding: int, actions: int) -> None:
        """Reads ``embedding`` numbers of a picture and ``actions`` of an action."""
        super().__init__()
        self.config = config
        self.actions = actions
        latent = config.groups * config.classes
        hidden = config.hidden
        self.inputs = nn.Sequential(
            nn.Linear(latent + actions + 1, hidden), nn.LayerNorm(hidden), nn.SiLU()
        )
        self.cell = nn.GRUCell(hidden, config.memory)
        self.prior = mlp(config.memory, hidden, 1, latent)
        self.posterior = mlp(config.memory + embedding, hidden, 1, latent)

    def initial(self, batch: int) -> Belief:
        """Before the first picture: zeros."""
        like = self.cell.weight_hh
        config = self.config
        latent = like.new_zeros(batch, config.groups, config.classes)
        return Belief(like.new_zeros(batch, config.memory), latent, latent)

    def advance(self, before: Belief, action: Float[Tensor, "B A"] | None) -> Float[Tensor, "B M"]:
        """The deterministic part one decision later; None: nobody knows what was done."""
        batch = len(before.deterministic)
        if action is None:
            done = before.deterministic.new_zeros(batch, self.actions + 1)
        else:
            done = torch.cat([action, action.new_ones(batch, 1)], 1)
        inputs = self.inputs(torch.cat([before.latent.flatten(1), done], 1))  # (B, hidden)
        return self.cell(inputs, before.deterministic)

    def prior_belief(
        self, deterministic: Float[Tensor, "B M"], noise: Float[Tensor, "B G"] | None
    ) -> Belief:
        """A belief without the picture."""
        return self._drawn(deterministic, self.prior(deterministic), noise)

    def posterior_belief(
        self,
        deterministic: Float[Tensor, "B M"],
        embedding: Float[Tensor, "B E"],
        noise: Float[Tensor, "B G"] | None,
    ) -> Belief:
        """A belief with the picture."""
        logits = self.posterior(torch.cat([deterministic, embedding], 1))
        return self._drawn(deterministic, logits, noise)

    def observe(
        self, embeddings: Float[Tensor, "T B E"], noise: Float[Tensor, "T B G"] | None
    ) -> Belief:
        """The belief after T pictures, rebuilt from the initial one without knowing what was done
        between them."""
        belief = self.initial(embeddings.shape[1])
        for t, embedding in enumerate(embeddings):
            deterministic = self.advance(belief, None)
            drawn = None if noise is None else noise[t]
            belief = self.posterior_belief(deterministic, embedding, drawn)
        return belief

    def _drawn(self, deterministic: Tensor, logits: Tensor, noise: Tensor | None) -> Belief:
        logits = logits.unflatten(1, (self.config.groups, self.config.classes))
        return Belief(deterministic, straight_through(logits, noise), logits)


def mlp(inputs: int, hidden: int, layers: int, outputs: int) -> nn.Sequential:
    """``layers`` hidden layers, each normalised."""
    parts: list[nn.Module] = []
    for _ in range(layers):
        parts += [nn.Linear(inputs, hidden), nn.LayerNorm(hidden), nn.SiLU()]
        inputs = hidden
    return nn.Sequential(*parts, nn.Linear(inputs, outputs))


def straight_through(
    logits: Float[Tensor, "... K"], noise: Tensor | None
) -> Float[Tensor, "... K"]:
    """One-hot values drawn by ``noise`` (...,), uniform in [0, 1), or the likeliest if None;
    backward, the probabilities themselves."""
    probabilities = logits.softmax(-1)
    if noise is None:
        index = logits.argmax(-1)
    else:
        # The value drawn is the first whose cumulated probability is above the noise.
        below = probabilities.detach().cumsum(-1) <= noise[..., None]  # (..., K)
        index = below.sum(-1).clamp(max=logits.shape[-1] - 1)
    drawn = F.one_hot(index, logits.shape[-1]).to(probabilities)
    return drawn + probabilities - probabilities.detach()


def categorical_kl(logits: Float[Tensor, "... G K"], other: Float[Tensor, "... G K"]) -> Tensor:
    """(...,): KL(logits || other) in nats, summed over the G choices."""
    log_p = logits.log_softmax(-1)
    log_q = other.log_softmax(-1)
    return (log_p.exp() * (log_p - log_q)).sum((-1, -2))


def balanced_kl(
    posterior: Float[Tensor, "... G K"],
    prior: Float[Tensor, "... G K"],
    balance: float,
    free: float,
) -> Float[Tensor, ""]:
    """``balance`` KL(sg(posterior) || prior) + (1 - ``balance``) KL(posterior || sg(prior)), each a
    mean over samples that counts as ``free`` nats where it is less (Hafner et al., 2021)."""
    teach = categorical_kl(posterior.detach(), prior).mean().clamp(min=free)
    please = categorical_kl(posterior, prior.detach()).mean().clamp(min=free)
    return balance * teach + (1 - balance) * please
