"""What a method trains on: the rows of one table.

A sample is encoded once per stream and then read several times: once *merged* (all streams summed)
and once for each *singular* subset, as if the other cameras were missing. A method says which
subsets those are, how much the two kinds weigh, and which feature its learning targets come from.
MAD with three streams and alpha 0.8 reads each sample four times:

    row         first + third_a + third_b    first    third_a    third_b
    weight      0.8                          0.0667   0.0667     0.0667     (0.2 in equal parts)
    targets     from the merged feature, in every row

A method also names its *merge* (``supports.py``, ``merge.py``): how the streams of a row become one
feature. The paper's merge methods are Merged Only with another merge; MVD and VIB bring their own,
and an extra loss each.

Everything that trains (the losses, imitation, checkpoints' cards) asks this table, so that another
weighting or another list of subsets is another row of it and no other code. No torch here.

Under ``light`` a row's target is the expert's action, the same for all rows: there ``targets``
changes nothing in what the actor learns, only in what the shown critic is fitted to. Naive Both is
then MAD with every row weighing alike, and Singular Only is MAD at alpha 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from madviz.agent.supports import SUPPORTS
from madviz.errors import UserError, unknown
from madviz.subsets import cameras_of, mad_subsets, mask_of, name_of, single_streams
from madviz.types import Array

Streams = tuple[str, ...]


@dataclass(frozen=True)
class Method:
    """One way to train; see the module for the words."""

    summary: str
    subsets: Callable[[Streams], Streams]
    """The singular subsets, by name."""
    weights: Callable[[float], dict[str, float]]
    """alpha -> the weight of each loss term: ``merged``; ``singular``, a mean over the singular
    rows; ``every``, a mean over all rows."""
    targets: Literal["merged", "own"] = "merged"
    """Where targets and the actor read Q: from the merged feature, or from each row's own."""
    recipes: tuple[str, ...] = ("paper", "paper-vectorised", "light")
    needs: tuple[str, ...] = ()
    """What must be there to train it, in words, for ``madviz list``."""
    min_streams: int = 1
    min_cameras: int = 1
    merge: str = "sum"
    """How the streams of a row become one feature: a row of ``SUPPORTS`` and ``MERGES``."""
    other_merges: bool = True
    """Whether the method also makes sense with another merge."""
    extra: Literal["none", "kl", "contrast"] = "none"
    """A loss besides the rows': VIB's bottleneck cost, or MVD's two contrastive losses."""
    one_camera: bool = False
    """Whether it takes one camera of the setting and leaves the others."""
    needs_camera: str = ""
    """A camera it cannot be built without."""

    def rows(self, streams: Streams) -> Streams:
        """The names of the N rows: the merged feature (``all``) first, then the subsets."""
        if len(streams) < self.min_streams:
            raise UserError(
                f"expected a setting with {self.min_streams} or more streams, found "
                f"{len(streams)} ({', '.join(streams)}); pick another setting or method"
            )
        self._check_cameras(streams)
        return ("all", *self.subsets(streams))

    def _check_cameras(self, streams: Streams) -> None:
        cameras = cameras_of(streams)
        if len(cameras) < self.min_cameras:
            raise UserError(
                f"expected a setting with {self.min_cameras} or more cameras, found "
                f"{', '.join(cameras)}; pick another setting or method"
            )
        if self.needs_camera and self.needs_camera not in cameras:
            raise UserError(
                f"expected a setting with the camera {self.needs_camera!r}, found "
                f"{', '.join(cameras)}; pick another setting or method"
            )

    def masks(self, streams: Streams) -> Array:
        """(N, V) bool: which streams are present in each row."""
        return np.stack([mask_of(row, streams) for row in self.rows(streams)])

    def row_weights(self, streams: Streams, alpha: float) -> Array:
        """(N,) float32, the share of each row in a loss; they sum to 1."""
        weights, rows = self.weights(alpha), self.rows(streams)
        every = weights.get("every", 0.0) / len(rows)
        singular = weights.get("singular", 0.0) / max(len(rows) - 1, 1) + every
        merged = weights.get("merged", 0.0) + every
        return np.array([merged, *[singular] * (len(rows) - 1)], np.float32)

    def trained_rows(self, streams: Streams) -> Array:
        """(N,) bool: which rows weigh anything."""
        return self.row_weights(streams, 0.5) > 0

    def trained_subsets(self, streams: Streams) -> Streams:
        """The subsets a policy learns to work from; the rest is off-training."""
        if self.extra == "contrast":
            # One row, but a drawn one: it is often a single stream's two parts.
            return ("all", *(name for name in single_streams(streams) if name != "all"))
        trained = self.masks(streams)[self.trained_rows(streams)]
        return tuple(name_of(mask, streams) for mask in trained)

    def merge_for(self, streams: Streams, asked: str = "") -> str:
        """The merge to train with: the one ``asked`` for, or the method's own.

        Raises UserError for an unknown one and for one that cannot form the method's rows.
        """
        if asked and asked not in SUPPORTS:
            raise unknown("merge", asked, list(SUPPORTS))
        chosen = asked or self.merge
        with_a_loss = [row.merge for row in METHODS.values() if row.extra != "none"]
        if chosen != self.merge and (not self.other_merges or chosen in with_a_loss):
            free = ", ".join(name for name, row in METHODS.items() if row.other_merges)
            raise UserError(
                f"expected the method's own merge {self.merge!r}, found {asked!r}; merges other "
                f"than {' and '.join(with_a_loss)} can be picked with: {free}"
            )
        for name, mask in zip(self.rows(streams), self.masks(streams), strict=True):
            if not SUPPORTS[chosen].allows(mask):
                raise UserError(
                    f"expected a merge that can form {name!r}, found {chosen!r}, which needs "
                    f"{SUPPORTS[chosen].words}; pick another merge, or method merged-only"
                )
        return chosen


def _mad(alpha: float) -> dict[str, float]:
    return {"merged": alpha, "singular": 1 - alpha}


def _merged_only(alpha: float) -> dict[str, float]:
    return {"merged": 1.0}


def _nothing(streams: Streams) -> Streams:
    return ()


_SEVERAL = ("two or more streams",)


def _merging(merge: str, how: str) -> Method:
    """A row of the paper's comparison of merges: Merged Only with another merge."""
    return Method(
        f"{how}, without disentanglement", _nothing, _merged_only, merge=merge, other_merges=False
    )


METHODS: dict[str, Method] = {
    "mad": Method(
        "merge and disentangle: every trained subset is an augmentation of the merged feature",
        subsets=mad_subsets,
        weights=_mad,
        needs=_SEVERAL,
        min_streams=2,
    ),
    "merged-only": Method(
        "all streams summed and nothing else: the baseline that was never disentangled",
        subsets=_nothing,
        weights=_merged_only,
    ),
    "singular-only": Method(
        "every subset alone and never the merge: each is its own teacher",
        subsets=mad_subsets,
        weights=lambda alpha: {"singular": 1.0},
        targets="own",
        needs=_SEVERAL,
        min_streams=2,
    ),
    "naive-both": Method(
        "merged and singular rows as if they were different samples: each is its own teacher and "
        "all weigh alike",
        subsets=mad_subsets,
        weights=lambda alpha: {"every": 1.0},
        targets="own",
        needs=_SEVERAL,
        min_streams=2,
    ),
    "single": Method(
        "one camera from the start, --camera: what the others are measured against",
        subsets=_nothing,
        weights=_merged_only,
        other_merges=False,
        one_camera=True,
    ),
    "mvd": Method(
        "multi-view disentanglement: shared and private parts, told apart by contrast",
        subsets=_nothing,
        weights=_merged_only,
        needs=_SEVERAL,
        min_streams=2,
        merge="mvd",
        other_merges=False,
        extra="contrast",
    ),
    "vib": Method(
        "variational information bottleneck on every view but the first person's",
        subsets=_nothing,
        weights=_merged_only,
        needs=("the camera first", "one or more other cameras"),
        min_cameras=2,
        merge="vib",
        other_merges=False,
        extra="kl",
        needs_camera="first",
    ),
    "frame-stack": _merging("frame-stack", "pixels stacked before one encoder"),
    "concat": _merging("concat", "features side by side"),
    "attention": _merging("attention", "features attend to each other, then summed"),
    "vit": _merging("vit", "one token per view through a transformer layer"),
    "q-mean": _merging("q-mean", "every view judged alone, actions and Q averaged"),
}


def method(name: str) -> Method:
    """The method called ``name``. Raises UserError listing the known ones."""
    if name not in METHODS:
        raise unknown("method", name, list(METHODS))
    return METHODS[name]
