"""The names of cameras, streams and subsets as people read them; commands have the keys."""

from __future__ import annotations

from madviz.session.frame import Frame
from madviz.subsets import camera_of, modality_of

MODALITY_WORDS = {"rgb": "colour", "depth": "depth"}
SPECIAL = {"all": "all", "none": "no camera", "rgb": "all colour", "depth": "all depth"}
"""The subsets that are not named after cameras."""


def subset_label(frame: Frame, subset: str, short: bool = False) -> str:
    """``First person + Third B depth`` for ``first+third_b.depth``; ``short``: ``First + Third B
    depth``, where the first word tells one camera from the others, and ``Third A + B``."""
    if subset in SPECIAL:
        return SPECIAL[subset]
    labels = [stream_label(frame, stream, "." in stream) for stream in subset.split("+")]
    if short:
        firsts = [camera.label.split()[0] for camera in frame.world.env.cameras]
        for camera, first in zip(frame.world.env.cameras, firsts, strict=True):
            if firsts.count(first) == 1:
                labels = [label.replace(camera.label, first) for label in labels]
        for place in range(len(labels) - 1, 0, -1):
            labels[place] = labels[place].removeprefix(f"{labels[place - 1].split()[0]} ")
    return " + ".join(labels)


def stream_label(frame: Frame, stream: str, with_modality: bool | None = None) -> str:
    """``Third A``, or ``Third A depth`` where a policy has both modalities, or as it is asked."""
    if with_modality is None:
        with_modality = len(set(map(modality_of, frame.world.policy.streams))) > 1
    label = frame.world.env.camera(camera_of(stream)).label
    return f"{label} {MODALITY_WORDS[modality_of(stream)]}" if with_modality else label
