"""The small language of camera subsets: names to masks and back.

A subset is written ``a+b``. Every part is a stream (``first.rgb``), a camera (all its streams), a
modality (``rgb``, ``depth``: all its streams), ``all`` or ``none``. With three cameras in two
modalities, ``first+third_a.depth`` is ``first.rgb``, ``first.depth`` and ``third_a.depth``:
the mask 1 1 0 1 0 0 over the streams in the order first.rgb, first.depth, third_a.rgb, ...
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import product
from types import MappingProxyType

import numpy as np

from madviz.errors import unknown
from madviz.types import Array


def camera_of(stream: str) -> str:
    """``first`` for both ``first.rgb`` and ``first``."""
    return stream.split(".")[0]


def modality_of(stream: str) -> str:
    """``rgb`` or ``depth``; a stream without a suffix is RGB unless its setting says otherwise."""
    return stream.split(".")[1] if "." in stream else "rgb"


def cameras_of(streams: tuple[str, ...]) -> tuple[str, ...]:
    """The cameras behind ``streams``, each once, in order."""
    return tuple(dict.fromkeys(camera_of(stream) for stream in streams))


@lru_cache(maxsize=256)
def groups(streams: tuple[str, ...]) -> Mapping[str, Array]:
    """Every single word of the language and its mask (V,) bool, read-only."""
    table = {"all": np.ones(len(streams), bool), "none": np.zeros(len(streams), bool)}
    for modality in dict.fromkeys(modality_of(stream) for stream in streams):
        table[modality] = np.array([modality_of(stream) == modality for stream in streams])
    for camera in cameras_of(streams):
        table[camera] = np.array([camera_of(stream) == camera for stream in streams])
    for index, stream in enumerate(streams):
        table[stream] = np.arange(len(streams)) == index
    for mask in table.values():
        mask.flags.writeable = False  # They are shared by all who ask.
    return MappingProxyType(table)


def mask_of(name: str, streams: tuple[str, ...]) -> Array:
    """(V,) bool of the subset ``name``. Raises UserError listing the known words."""
    table = groups(streams)
    mask = np.zeros(len(streams), bool)
    for word in name.split("+"):
        if word.strip() not in table:
            raise unknown("camera subset", word.strip(), list(table))
        mask |= table[word.strip()]
    return mask


def name_of(mask: Array, streams: tuple[str, ...]) -> str:
    """The shortest honest name: one word of the language if there is one, otherwise ``a+b``."""
    return _name_of(np.asarray(mask, bool).tobytes(), streams)


@lru_cache(maxsize=4096)
def _name_of(bits: bytes, streams: tuple[str, ...]) -> str:
    mask = np.frombuffer(bits, bool)
    table = groups(streams)
    several = len(set(map(modality_of, streams))) > 1
    for word, group in table.items():
        if (several or word not in ("rgb", "depth")) and np.array_equal(group, mask):
            return word
    parts: list[str] = []
    for camera in cameras_of(streams):
        own = np.array([camera_of(stream) == camera for stream in streams])
        if np.array_equal(table[camera], own) and mask[own].all():
            parts.append(camera)  # Where a stream has the camera's name, the word means that one.
        else:
            parts += [s for s, on, mine in zip(streams, mask, own, strict=True) if on and mine]
    return "+".join(parts)


def every_mask(count: int) -> Array:
    """(2^V, V) bool: all subsets, the full one first, the empty one last."""
    return np.array(list(product((True, False), repeat=count)), bool).reshape(-1, count)


def row_of(mask: Array) -> int:
    """Where ``mask`` (V,) stands in ``every_mask``: its bits as a binary number, inverted."""
    row = 0
    for on in np.asarray(mask, bool).tolist():
        row = 2 * row + (not on)
    return row


def single_streams(streams: tuple[str, ...]) -> tuple[str, ...]:
    """The subsets of one stream each, by name."""
    return tuple(name_of(np.arange(len(streams)) == i, streams) for i in range(len(streams)))


def mad_subsets(streams: tuple[str, ...]) -> tuple[str, ...]:
    """The subsets that MAD trains besides the merge: every single stream, as in the paper; where
    cameras have several modalities, every camera and every modality too, so that each can be
    switched off whole.

    A word that means all streams, as the only camera does, is the merge itself and not listed.
    """
    names = dict.fromkeys(name_of(mask, streams) for mask in groups(streams).values())
    return tuple(name for name in names if name not in ("all", "none"))
