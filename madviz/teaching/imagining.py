"""For lesson 8: what a policy imagines of a missing camera, and of the next decisions.

Everything is held against what happened in an episode that was played with all cameras: dB over the
pixels that move, see ``madviz.analysis.imagination``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from madviz.analysis.foresight import foresee
from madviz.analysis.imagination import Imagined, imagined, moving_psnr
from madviz.errors import UserError
from madviz.subsets import mask_of
from madviz.teaching.episode import Moment
from madviz.teaching.names import named
from madviz.teaching.show import Picture, sheet
from madviz.types import Imagines


def imagined_at(moment: Moment, subset: str) -> dict[str, Imagined]:
    """By name, every stream that is not in ``subset``, imagined from those that are. Raises
    UserError for unknown words, and for a policy that cannot imagine."""
    policy = moment.policy
    mask = mask_of(subset, policy.spec.streams)
    encoded = policy.encode(moment.stack, moment.state)
    found = imagined(policy, encoded, mask, mask, moment.views, moment.env)
    if not found:
        raise UserError(f"{policy.spec.name} imagines nothing from {subset!r}; drop a camera")
    return found


def imagined_sheet(moment: Moment, subset: str, size: int = 168) -> Picture:
    """Every stream that is not in ``subset``: what it shows, and what is imagined."""
    shown = {}
    for name, one in imagined_at(moment, subset).items():
        shown[named(name)] = moment.arrived[name]
        shown[f"{named(name)}, imagined: {one.psnr:.0f} dB"] = one.picture
    return sheet(shown, size)


def imagined_psnr(episode: Sequence[Moment], stream: str, subset: str) -> float:
    """dB of ``stream``, imagined from ``subset``, the mean over the episode's time steps at which
    something moves in it."""
    return float(np.nanmean([imagined_at(moment, subset)[stream].psnr for moment in episode]))


def foreseen_sheet(
    episode: Sequence[Moment],
    step: int,
    subset: str,
    stream: str,
    after: Sequence[int] = (1, 3, 5, 10, 15),
    size: int = 112,
) -> Picture:
    """The picture of ``stream`` ``after`` so many decisions, and below what was foreseen at
    ``step`` from ``subset``, without a picture since. Raises UserError where the episode is too
    short, and for a policy without a world model. ``after``: 15 at most."""
    moment = episode[step]
    policy = episode[step].policy
    if step + max(after) >= len(episode):
        raise UserError(f"expected {max(after)} decisions after step {step}; begin earlier")
    streams = policy.spec.streams
    encoded = policy.encode(moment.stack, moment.state)
    future = foresee(policy, encoded, mask_of(subset, streams), step, subset).future
    place = streams.index(stream)
    assert isinstance(policy, Imagines), "what has a world model can draw"
    usual = policy.mean_pictures()[place]
    happened = {}
    foreseen = {}
    for n in after:
        truth = episode[step + n].arrived[stream]
        drawn = future.pictures[n - 1, place]
        happened[f"after {n}"] = truth
        foreseen[f"foreseen {n}: {moving_psnr(drawn, truth, usual):.0f} dB"] = drawn
    return sheet({**happened, **foreseen}, size, columns=len(after))
