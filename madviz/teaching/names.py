"""The cameras of lessons by the names that people read; a student writes the keys in code."""

from __future__ import annotations

import re

from madviz.envs.toy import CAMERAS
from madviz.session.camera_names import MODALITY_WORDS, SPECIAL
from madviz.subsets import camera_of, modality_of

LABELS = {camera.name: camera.label for camera in CAMERAS}
"""Those of a setting ``three``, the same in every suite."""
STREAMS = re.compile(rf"\b(?:{'|'.join(LABELS)})(?:\.(?:{'|'.join(MODALITY_WORDS)}))?\b")


def named(words: str) -> str:
    """``First person + Third B depth`` for ``first+third_b.depth``, ``Third A dropped`` for
    ``third_a dropped``, ``no camera`` for ``none``; other words stay."""
    if words in SPECIAL:
        return SPECIAL[words]
    return STREAMS.sub(_stream, words.replace("+", " + "))


def _stream(found: re.Match[str]) -> str:
    label = LABELS[camera_of(found[0])]
    return f"{label} {MODALITY_WORDS[modality_of(found[0])]}" if "." in found[0] else label
