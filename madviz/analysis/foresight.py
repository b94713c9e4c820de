"""The decisions that a policy imagines, beside those that then happen.

A policy with a world model (``madviz.types.Foresees``) can go on without pictures: it imagines what
it decides next, what its cameras would show after each decision, those included that it has lost,
and the rewards. Then the episode goes on, and each decision that really comes stands beside the one
that was imagined. That is a fair test only while the cameras stay as they were, so it is noted when
they do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from madviz.analysis.imagination import moving_psnr
from madviz.errors import UserError
from madviz.observation.streams import stream_frame
from madviz.subsets import camera_of, name_of
from madviz.types import Array, Encoded, EnvSpec, Foresees, Future, Imagines, Policy, View

DECISIONS = 15
"""That are imagined: as many as in training."""


@dataclass(frozen=True)
class Happened:
    """The outcome of one decision that had been imagined."""

    pictures: tuple[Array, ...]
    """(H, W, C) uint8 of each stream, as its camera sees it."""
    psnr: tuple[float, ...]
    """The quality of each stream's imagined picture, in dB over the pixels that move; NaN where
    next to none do."""
    reward: float


@dataclass(frozen=True)
class Foresight:
    """The imagined course of some decisions, and as much of the real one as is known."""

    step: int
    """Before the first of them."""
    condition: str
    """The cameras and occlusions when the policy imagined."""
    streams: tuple[str, ...]
    future: Future
    happened: tuple[Happened, ...] = ()
    disturbed: bool = False
    """Whether the condition was another one later: what happened then tells nothing of how well it
    was imagined."""
    closed: bool = False
    """Whether nothing more will be held against it: all has happened, or the episode is over."""


def can_foresee(policy: Policy) -> bool:
    """Whether ``policy`` has a world model that goes on without pictures."""
    return isinstance(policy, Foresees) and policy.foresees


def foresee(policy: Policy, encoded: Encoded, mask: Array, step: int, condition: str) -> Foresight:
    """Lets ``policy`` imagine from the streams in ``mask`` (V,). Raises UserError where it cannot,
    or cannot act on these streams."""
    if not (isinstance(policy, Foresees) and policy.foresees):
        raise UserError(
            f"expected a policy with a world model, found {policy.spec.name}, which has none; "
            "choose one of the method mv-mwm"
        )
    streams = policy.spec.streams
    if not policy.supports(mask):
        raise UserError(
            f"{policy.spec.name} cannot act on {name_of(mask, streams)!r}; switch another camera on"
        )
    return Foresight(step, condition, streams, policy.foresee(encoded, mask, DECISIONS))


def then(
    before: Foresight,
    policy: Policy,
    views: dict[str, View],
    env: EnvSpec,
    reward: float,
    condition: str,
) -> Foresight:
    """``before`` after one more decision, which led to ``views`` and ``reward``."""
    if before.closed:
        return before
    imagined = before.future.pictures[len(before.happened)]
    size = policy.spec.image_size
    streams = before.streams
    pictures = tuple(stream_frame(views[camera_of(s)], s, env, size) for s in streams)
    usual = policy.mean_pictures() if isinstance(policy, Imagines) else imagined
    psnr = tuple(
        moving_psnr(drawn, truth, mean)
        for drawn, truth, mean in zip(imagined, pictures, usual, strict=True)
    )
    happened = (*before.happened, Happened(pictures, psnr, reward))
    return replace(
        before,
        happened=happened,
        disturbed=before.disturbed or condition != before.condition,
        closed=len(happened) == len(before.future.reward),
    )


def mean_psnr(foresight: Foresight) -> float:
    """dB, of all pictures that have happened; NaN where nothing moved."""
    known = np.array([one.psnr for one in foresight.happened], float)
    return float(np.nanmean(known)) if np.isfinite(known).any() else float("nan")
