"""Which subsets of streams each way to merge can act on, in code and in words. No torch here.

A sum can be taken over any subset, the empty one included; a stack of pixels has a place for every
stream and nothing to put into an empty one. Pages, evaluations and the list of methods ask this
table, so that "cannot do without" is a fact of a merge and not a special case anywhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from madviz.types import Array


@dataclass(frozen=True)
class Support:
    """What a merge can act on."""

    words: str
    allows: Callable[[Array], bool]
    """A mask (V,) bool -> whether a feature can be formed from the streams that are present."""


def _any(mask: Array) -> bool:
    return True


def _some(mask: Array) -> bool:
    return bool(np.any(mask))


def _all(mask: Array) -> bool:
    return bool(np.all(mask))


def _all_or_one(mask: Array) -> bool:
    return bool(np.all(mask)) or int(np.sum(mask)) == 1


_SOME = Support("any subset with at least one stream", _some)
_ALL = Support("all streams together, and nothing less", _all)

SUPPORTS: dict[str, Support] = {
    "sum": Support("any subset, the empty one included", _any),
    "concat": _ALL,
    "frame-stack": _ALL,
    "attention": _SOME,
    "vit": _SOME,
    "q-mean": _SOME,
    "mvd": _SOME,
    "vib": Support("all streams together, or one alone", _all_or_one),
}
"""Name of a merge -> what it supports; the networks are in ``merge.py`` under the same names."""
