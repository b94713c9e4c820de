"""Pictures that a policy imagines of a camera that it has lost, and how good they are.

Most policies cannot be asked. One that has learned to draw (``madviz.types.Imagines``) draws every
stream from those that are present; what it draws of an absent one is held against what that camera
sees. Most of a picture never changes, so only the pixels that move are judged: a hand drawn 10 of
255 wrong everywhere has 28 dB, one drawn 100 of 255 wrong has 8 dB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from madviz.agent.sizes import FEWEST_MOVING, MOVING
from madviz.observation.streams import stream_frame
from madviz.subsets import camera_of
from madviz.types import Array, Encoded, EnvSpec, Imagines, Policy, View


@dataclass(frozen=True)
class Imagined:
    """One stream that is not present."""

    picture: Array
    """(H, W, 3) uint8."""
    psnr: float
    """dB over the pixels that move; NaN where next to none do."""


def imagined(
    policy: Policy,
    encoded: Encoded,
    present: Array,
    used: Array,
    views: dict[str, View],
    env: EnvSpec,
) -> dict[str, Imagined]:
    """Every stream that is not ``present`` (V,), by name, drawn from those that are ``used`` (V,):
    a guard leaves out more. Beside it, what its camera sees in ``views``. Nothing where ``policy``
    cannot draw or cannot act on the rest."""
    streams = policy.spec.streams
    if present.all() or not (isinstance(policy, Imagines) and policy.imagines):
        return {}
    if not policy.supports(used):
        return {}
    drawn = policy.imagine(encoded, used)
    usual = policy.mean_pictures()
    found = {}
    for v in np.flatnonzero(~present):
        stream = streams[v]
        truth = stream_frame(views[camera_of(stream)], stream, env, policy.spec.image_size)
        found[stream] = Imagined(drawn[v], moving_psnr(drawn[v], truth, usual[v]))
    return found


def moving_psnr(drawn: Array, truth: Array, usual: Array) -> float:
    """Peak signal-to-noise ratio in dB of pictures (H, W, 3) uint8, over the pixels in which
    ``truth``, which may have one channel for all, differs from ``usual`` by more than 10 of 255."""
    truth = np.broadcast_to(truth, drawn.shape).astype(np.float32) / 255
    moves = (np.abs(truth - usual.astype(np.float32) / 255) > MOVING).any(-1)
    if moves.sum() < FEWEST_MOVING:
        return float("nan")
    error = float(np.square(drawn[moves].astype(np.float32) / 255 - truth[moves]).mean())
    return float(-10 * np.log10(max(error, 1e-10)))
