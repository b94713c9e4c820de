"""How much each camera adds: Shapley values over the sets of cameras.

The problem: take the first camera away and little happens, because the others know the same; take
the second one away, too, and all is lost. Which of them mattered more? One removal alone
answers 'neither'.

The idea (L. S. Shapley, A value for n-person games, 1953): let the cameras come in one after the
other, note what each adds to a number v when it comes, and average that over all orders. Camera c
adds v(S + c) - v(S) when the set S is there already, and so many orders put S before it:

    value(c) = sum over S without c of  |S|! (C - |S| - 1)! / C!  * (v(S + c) - v(S))

Three things hold, and no other way of sharing has them all: the values sum to v(all) - v(none);
cameras that always add the same get the same; a camera that never adds anything gets 0.

Worked, two cameras, success 0.0 without any, 0.2 and 0.6 with one, 1.0 with both. The first adds
0.2 when it comes first and 1.0 - 0.6 = 0.4 when it comes last: its value is 0.3. The second adds
0.6 or 0.8: its value is 0.7. Together 1.0.

A player is a *camera*: its colour and its depth come and go together. With C cameras there are 2^C
sets, and a Shapley value is linear in their v, so that one (C, 2^C) matrix, made once, does it all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import factorial

import numpy as np

from madviz.analysis.probes import Probe
from madviz.errors import UserError
from madviz.subsets import camera_of, cameras_of, every_mask, name_of
from madviz.types import Array

Bounded = tuple[float, float, float]
"""A rate and the ends of its interval."""


@dataclass(frozen=True)
class ShapleyValues:
    """The Shapley values of the cameras, and what they share."""

    cameras: Array
    """(C,) the value of each; NaN where it is not defined."""
    empty: float
    """v with no camera at all."""
    full: float
    """v with all cameras that are present; ``nothing`` and the values sum to it."""


@lru_cache(maxsize=8)
def shares(count: int) -> Array:
    """(C, 2^C) float64: Shapley values = shares @ values, values in the order of ``every_mask``."""
    if count < 1:
        raise UserError("expected one camera or more, found none; name the cameras of a policy")
    sets = every_mask(count)  # (2^C, C)
    sizes = sets.sum(1)  # (2^C,)
    # The share of all orders in which a camera comes after exactly k others.
    orders = [factorial(k) * factorial(count - k - 1) / factorial(count) for k in range(count)]
    matrix = np.empty((count, len(sets)))
    for camera in range(count):
        there = sets[:, camera]
        # A set with the camera counts for it, the same set without it against it.
        matrix[camera, there] = [orders[size - 1] for size in sizes[there]]
        matrix[camera, ~there] = [-orders[size] for size in sizes[~there]]
    return matrix


def shapley(values: Array) -> Array:
    """(2^C,) or (2^C, K) values of the sets, in the order of ``every_mask`` -> (C,) or (C, K).

    NaN in, NaN out: a game that cannot be played with every set has no Shapley value.
    Raises UserError for a number of values that is no power of two.
    """
    values = np.asarray(values, np.float64)
    count = len(values).bit_length() - 1
    if len(values) != 2**count:
        raise UserError(
            f"expected a value for each of 2^C sets of cameras, found {len(values)}; "
            "give the full set first and the empty one last"
        )
    return shares(count) @ values


def camera_masks(streams: tuple[str, ...], present: Array | None = None) -> Array:
    """(2^C, V) bool: the streams of every set of cameras, the full set first, the empty one last.

    Streams that are not ``present`` (V,) are in no set, so the value of a dropped camera is 0.
    """
    cameras = cameras_of(streams)
    owner = np.array([cameras.index(camera_of(stream)) for stream in streams])  # (V,)
    masks = every_mask(len(cameras))[:, owner]  # (2^C, C) -> (2^C, V)
    return masks if present is None else masks & np.asarray(present, bool)


def q_shapley(
    probe: Probe, streams: tuple[str, ...], present: Array | None = None
) -> ShapleyValues:
    """The cameras' shares in Q, the critic's forecast, at this time step. NaN without a critic, and
    where the policy cannot act on some of the sets."""
    rows = [probe.row(mask) for mask in camera_masks(streams, present)]
    return _values(probe.readout.q[rows].astype(np.float64))


def action_shapley(
    probe: Probe, streams: tuple[str, ...], present: Array | None = None
) -> ShapleyValues:
    """By how much each camera brings the action nearer to the one that all of them give.

    v(S) = -|a(S) - a(all present)|, the Euclidean distance in action units. An action has several
    numbers, and every one of them could be shared out by itself: but then a camera has A values,
    and values of opposite sign in different numbers cannot be ranked. The distance makes it one
    number in units that can be seen (0.3 is 15 % of one motor's range of -1 to 1), and signed: a
    camera that pulls away from what is finally done has a negative value. What is shared is how
    far the action goes from blind to seeing, |a(none) - a(all)|.
    """
    rows = [probe.row(mask) for mask in camera_masks(streams, present)]
    actions = probe.readout.action[rows].astype(np.float64)  # (2^C, A); all present first.
    return _values(-np.linalg.norm(actions - actions[0], axis=1))


def success_shapley(
    rates: Mapping[str, float], streams: tuple[str, ...], present: Array | None = None
) -> ShapleyValues | None:
    """The cameras' shares in the measured success: ``rates`` by subset, under the names of
    ``subsets.name_of``. None where one of the 2^C sets of cameras was not measured."""
    names = set_names(streams, present)
    if any(not np.isfinite(rates.get(name, np.nan)) for name in names):
        return None
    return _values(np.array([rates[name] for name in names]))


def success_interval(
    rates: Mapping[str, Bounded], streams: tuple[str, ...], present: Array | None = None
) -> tuple[Array, Array]:
    """(C,) low and (C,) high ends of the values in success, from the intervals of the rates.

    A Shapley value is a weighted sum of rates measured independently. The distances from each rate
    to the ends of its own interval, weighted, add like the sides of a right angle (Zou and Donner,
    Statistics in Medicine 2008), so that the interval is of the same level as those of the rates.
    """
    names = set_names(streams, present)
    place = {name: index for index, name in enumerate(dict.fromkeys(names))}
    weights = np.zeros((len(cameras_of(streams)), len(place)))
    for index, name in enumerate(names):  # Sets that are one subset are one measurement.
        weights[:, place[name]] += shares(len(weights))[:, index]
    mean, low, high = (np.array([rates[name][end] for name in place]) for end in range(3))
    middle = weights @ mean  # (C,)
    ends = np.stack([weights * (low - mean), weights * (high - mean)])  # (2, C, rates)
    below = np.sqrt((np.minimum(ends[0], ends[1]) ** 2).sum(1))
    above = np.sqrt((np.maximum(ends[0], ends[1]) ** 2).sum(1))
    return middle - below, middle + above


def set_names(streams: tuple[str, ...], present: Array | None = None) -> tuple[str, ...]:
    """The subset behind every set of cameras, by name; as long as ``camera_masks``."""
    return tuple(name_of(mask, streams) for mask in camera_masks(streams, present))


def _values(values: Array) -> ShapleyValues:
    return ShapleyValues(shapley(values), float(values[-1]), float(values[0]))
