"""The places that an action depends on, at one step of an episode, as pictures on a page."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from madviz.analysis.covering import Covered, covered
from madviz.analysis.saliency import saliency
from madviz.measure.episodes import Job, Runner, one_thread
from madviz.measure.mean_picture import mean_pictures
from madviz.observation.streams import to_channels
from madviz.subsets import camera_of
from madviz.types import Array, Environment, Policy

SIDE = 168
"""Pixels of a camera."""


def places_html(
    looks: Sequence[tuple[Array, Array]], step: int | None, job: Job, runner: Runner
) -> str:
    """The maps of the first episode at ``step``, where the actions part; '' where they do not, and
    where no ``looks`` were kept. The control's frame is half an episode away."""
    if step is None or not looks:
        return ""
    env, policy = runner.opened(job)
    streams = policy.spec.streams
    mask = job.condition.at(step).mask(streams)
    means, note = _means(policy, env, looks)
    views, state = looks[step]
    other, _ = looks[(step + len(looks) // 2) % len(looks)]
    with one_thread():
        found = covered(
            policy,
            views,
            state,
            mask,
            means,
            other,
        )
        slopes = saliency(policy, views, state, mask, "action")
    rows = [_row(views, found.distance / max(float(found.peak.max()), 1e-9))]
    rows += [] if slopes is None else [_row(views, slopes)]
    done, file = cv2.imencode(".jpg", np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    beside = "" if slopes is None else " Under it, the gradient of the network."
    labels = [env.spec.camera(camera_of(stream)).label for stream in streams]
    return (
        f"<p>Where {escape(policy.spec.name)} looks at step {step} of the episode above: bright is "
        f"where covering moves the action.{note}{beside} {escape(place_words(found, labels))}</p>"
        '<img alt="where the policy looks, camera by camera" '
        f'src="data:image/jpeg;base64,{b64encode(file.tobytes()).decode()}">'
    )


def _means(
    policy: Policy, env: Environment, looks: Sequence[tuple[Array, Array]]
) -> tuple[Array, str]:
    """The mean pictures (V, 3, H, W), and a sentence on them where they are not the usual ones."""
    streams = policy.spec.streams
    try:
        known = mean_pictures(env.spec, streams, policy.spec.image_size)
    except Exception:  # The expert of an own task may raise anything.
        frames = np.stack([views[:, -3:] for views, _ in looks])  # (T, V, 3, H, W)
        words = " The task has no expert, so the mean picture is that of this episode."
        return np.round(frames.mean(0)).astype(np.uint8), words
    return np.stack([to_channels(known[stream]) for stream in streams]), ""


def place_words(found: Covered, labels: Sequence[str]) -> str:
    """``First person: up to 0.43. Third A: nothing here (up to 0.01, control 0.02).``"""
    words = []
    for label, peak, level, something in zip(
        labels, found.peak, found.level, found.found, strict=True
    ):
        what = f"up to {peak:.2f}" if something else f"nothing here (up to {peak:.2f}"
        words.append(f"{label}: {what}{'' if something else f', control {level:.2f})'}.")
    return " ".join(words)


def _row(views: Array, shares: Array) -> Array:
    """(SIDE, W, 3) BGR: the newest frame of every stream under its map, shares (V, H, W)."""
    tiles = []
    for view, share in zip(views, shares, strict=True):
        picture = cv2.cvtColor(
            np.ascontiguousarray(view[-3:].transpose(1, 2, 0)), cv2.COLOR_RGB2BGR
        )
        weight = cv2.resize(share.astype(np.float32), (SIDE, SIDE))[..., None]
        colours = cv2.applyColorMap((255 * weight[..., 0]).astype(np.uint8), cv2.COLORMAP_INFERNO)
        large = cv2.resize(picture, (SIDE, SIDE))
        tiles += [(0.5 * large * (1 - weight) + colours * weight).astype(np.uint8)]
        tiles += [np.full((SIDE, 4, 3), 40, np.uint8)]
    return np.concatenate(tiles[:-1], axis=1)
