"""Which pixels an action depends on, found from outside: cover a patch, see how far it moves.

A gradient needs a network, and one that is large somewhere says nothing about a change of more than
a grey level. Covering works for any policy, also a served one: a patch of a camera's picture is
replaced by the camera's mean picture, and the distance between the action and the one before is
noted for all pixels under the patch. The grid of patches is laid in ``PHASES`` places and the
distances are averaged, so that the map is finer than a patch.

A control says how much a patch moves the action wherever it is: the same patches, taken from
another frame of the same camera. A camera whose map stays within twice the middle of its control,
and below ``SMALL``, has nothing that the action depends on.

Worked: 84 pixels, patches of 21: 81 patches a camera in the four phases, and as many for the
control, so three cameras take 487 actions: 2 s for MAD, and half a minute for a server that takes
60 ms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from madviz.types import Array, Policy

PARTS = 4
"""Patches in a row."""
PHASES = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Halves of a patch by which the grid is moved, down and to the right."""
SMALL = 0.02
"""A distance between actions that counts as none; an action's numbers lie in [-1, 1]."""


@dataclass(frozen=True)
class Covered:
    """The maps of all streams."""

    distance: Array
    """(V, H, W): how far the action moves when this place is covered; 0 for absent streams."""
    control: Array
    """(V, H, W): the same with patches from another frame."""

    @property
    def level(self) -> Array:
        """(V,) the distance up to which there is nothing."""
        middle = np.median(self.control.reshape(len(self.control), -1), axis=1)
        return np.maximum(2 * middle, SMALL)

    @property
    def peak(self) -> Array:
        """(V,) the greatest distance."""
        return self.distance.max((1, 2))

    @property
    def found(self) -> Array:
        """(V,) bool: the action depends on something in this stream."""
        return self.peak > self.level


def covered(
    policy: Policy, views: Array, state: Array, mask: Array, means: Array, other: Array
) -> Covered:
    """The maps of ``views`` (V, C, H, W) uint8 and ``state`` (S,) on the subset ``mask`` (V,) bool.

    ``means`` (V, 3, H, W) are the mean pictures, ``other`` (V, C, H, W) is another frame.
    """
    frames = views.shape[1] // 3
    fills = np.tile(means, (1, frames, 1, 1)), other  # (V, C, H, W) each
    before = _action(policy, views, state, mask)
    maps = np.zeros((2, len(views), *views.shape[2:]))  # (2, V, H, W)
    for stream in np.flatnonzero(mask):
        for number, fill in enumerate(fills):
            for rows, columns in _patches(views.shape[2]):
                changed = views.copy()
                changed[stream, :, rows, columns] = fill[stream, :, rows, columns]
                moved = np.linalg.norm(_action(policy, changed, state, mask) - before)
                maps[number, stream, rows, columns] += moved / len(PHASES)
    return Covered(*maps)


def _action(policy: Policy, views: Array, state: Array, mask: Array) -> Array:
    return policy.read(policy.encode(views, state), mask[None]).action[0]  # (A,)


def _patches(size: int) -> Iterator[tuple[slice, slice]]:
    """The patches of all phases; each pixel is in one of every phase."""
    patch = size // PARTS
    for phase in PHASES:
        starts = [range(-part * (patch // 2), size, patch) for part in phase]
        for row in starts[0]:
            for column in starts[1]:
                yield (
                    slice(max(row, 0), min(row + patch, size)),
                    slice(max(column, 0), min(column + patch, size)),
                )
