"""Methods: which rows each trains on; one table.

A sample is encoded once per stream and then read several times: once *merged* (all streams summed)
and once for each *singular* subset, as if the other cameras were missing. A method says which
subsets those are, how much the two kinds weigh, and which feature its learning targets come from.
MAD with three streams and alpha 0.8 reads each sample four times:

    row         first + third_a + third_b    first    third_a    third_b
    weight      0.8                          0.0667   0.0667     0.0667     (0.2 in equal parts)
    targets     from the merged feature, in every row

A method also names its *merge* (``merges/merge_table.py``): how the streams of a row become one
feature. Every merge but the sum is a method of its own, too: Merged Only with that merge. Those of
MVD and VIB bring a loss besides.

Everything that trains (the losses, imitation, checkpoints' cards) asks this table, so that another
weighting or another list of subsets is another row of it and no other code. No torch here.

Under ``light`` a row's target is the expert's action, the same for all rows: there ``targets``
changes nothing in what the actor learns, only in what the shown critic is fitted to. Naive Both is
then MAD with every row weighing alike. In the loss, Singular Only is MAD at alpha 0 and Merged Only
MAD at alpha 1; in whom it lets drive while recording, it is not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from madviz.agent.merges.merge_table import MERGES, SEVERAL_STREAMS, MergeFacts, Needs
from madviz.errors import UserError, unknown
from madviz.subsets import every_mask, mad_subsets, mask_of, name_of, single_streams
from madviz.types import Array, PolicySpec

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
    """Targets and the actor read Q there: from the merged feature, or from each row's own."""
    recipes: tuple[str, ...] = ("paper", "paper-vectorised", "light")
    needs: Needs = Needs()
    """A setting must have these."""
    merge: str = "sum"
    """How the streams of a row become one feature: a row of ``MERGES``."""
    other_merges: bool = True
    """Whether the method also makes sense with another merge."""
    one_camera: bool = False
    """Whether it takes one camera of the setting and leaves the others."""
    page_words: str = ""
    """A sentence for visitors of the page who never heard of it."""

    def rows(self, streams: Streams) -> Streams:
        """The names of the N rows: the merged feature (``all``) first, then the subsets."""
        self.needs.check(streams)
        return ("all", *self.subsets(streams))

    def masks(self, streams: Streams) -> Array:
        """(N, V) bool: which streams are present in each row."""
        return np.stack([mask_of(row, streams) for row in self.rows(streams)])

    def row_weights(self, streams: Streams, alpha: float) -> Array:
        """(N,) float32, the share of each row in a loss; they sum to 1."""
        weights = self.weights(alpha)
        rows = self.rows(streams)
        every = weights.get("every", 0.0) / len(rows)
        singular = weights.get("singular", 0.0) / max(len(rows) - 1, 1) + every
        merged = weights.get("merged", 0.0) + every
        return np.array([merged, *[singular] * (len(rows) - 1)], np.float32)

    def alpha_of(self, alpha: float) -> float | None:
        """``alpha``, where training by this method depends on it; None where it changes nothing,
        because the weights are fixed."""
        return alpha if self.weights(0.0) != self.weights(1.0) else None

    def trained_rows(self, streams: Streams, alpha: float = 0.5) -> Array:
        """(N,) bool: which rows weigh anything; by default at an ``alpha`` between 0 and 1."""
        return self.row_weights(streams, alpha) > 0

    def trained_subsets(self, streams: Streams, alpha: float = 0.5) -> Streams:
        """The subsets a policy learns to work from; on the rest it is not trained. ``alpha`` is
        that of its training; every one between 0 and 1 gives the same."""
        if MERGES[self.merge].trains_each_alone:
            return ("all", *(name for name in single_streams(streams) if name != "all"))
        trained = self.masks(streams)[self.trained_rows(streams, alpha)]
        return tuple(name_of(mask, streams) for mask in trained)

    def merge_for(self, streams: Streams, asked: str = "") -> str:
        """The merge to train with: the one ``asked`` for, or the method's own.

        Raises UserError for an unknown one and for one that cannot form the method's rows.
        """
        if asked and asked not in MERGES:
            raise unknown("merge", asked, list(MERGES))
        chosen = asked or self.merge
        with_a_loss = [name for name, merge in MERGES.items() if merge.own_loss]
        if chosen != self.merge and (not self.other_merges or chosen in with_a_loss):
            free = ", ".join(name for name, row in METHODS.items() if row.other_merges)
            raise UserError(
                f"expected the method's own merge {self.merge!r}, found {asked!r}; merges other "
                f"than {', '.join(with_a_loss)} can be picked with: {free}"
            )
        for name, mask in zip(self.rows(streams), self.masks(streams), strict=True):
            if not MERGES[chosen].support.allows(mask):
                raise UserError(
                    f"expected a merge that can form {name!r}, found {chosen!r}, which needs "
                    f"{MERGES[chosen].support.words}; pick another merge, or method merged-only"
                )
        return chosen


def _mad(alpha: float) -> dict[str, float]:
    return {"merged": alpha, "singular": 1 - alpha}


def _merged_only(alpha: float) -> dict[str, float]:
    return {"merged": 1.0}


def _nothing(streams: Streams) -> Streams:
    return ()


def _every_other_subset(streams: Streams) -> Streams:
    return tuple(name_of(mask, streams) for mask in every_mask(len(streams))[1:-1])


def _merging(name: str, merge: MergeFacts) -> Method:
    """Merged Only with another merge: the paper's comparison of merges, MVD and VIB."""
    return Method(
        merge.summary if merge.own_loss else f"{merge.summary}, without disentanglement",
        _nothing,
        _merged_only,
        needs=merge.needs,
        merge=name,
        other_merges=False,
        page_words=merge.page_words,
    )


METHODS: dict[str, Method] = {
    "mad": Method(
        "merge and disentangle: every trained subset is an augmentation of the merged feature",
        subsets=mad_subsets,
        weights=_mad,
        needs=SEVERAL_STREAMS,
        page_words="MAD: works with all cameras and with each one alone.",
    ),
    "merged-only": Method(
        "all streams summed, trained on the sum only",
        subsets=_nothing,
        weights=_merged_only,
        page_words="Merged Only: works with all of them together.",
    ),
    "singular-only": Method(
        "every subset alone and never the merge: each is its own teacher",
        subsets=mad_subsets,
        weights=lambda alpha: {"singular": 1.0},
        targets="own",
        needs=SEVERAL_STREAMS,
        page_words="Singular Only: works with each camera alone.",
    ),
    "naive-both": Method(
        "merged and singular rows as if they were different samples: each is its own teacher and "
        "all weigh alike",
        subsets=mad_subsets,
        weights=lambda alpha: {"every": 1.0},
        targets="own",
        needs=SEVERAL_STREAMS,
        page_words="Naive Both: works with all cameras and with each alone, each its own teacher.",
    ),
    "single": Method(
        "one camera from the start, --camera: what the others are measured against",
        subsets=_nothing,
        weights=_merged_only,
        other_merges=False,
        one_camera=True,
        page_words="Single: works with one camera.",
    ),
    **{name: _merging(name, merge) for name, merge in MERGES.items() if name != "sum"},
    "mv-mae": replace(
        _merging("mv-mae", MERGES["mv-mae"]),
        summary="MV-MAE + imitation: tokens of a masked autoencoder over views; not MV-MWM, which "
        "learns a world model on them",
        subsets=mad_subsets,
        weights=_mad,
        recipes=("light",),
    ),
    "mv-mwm": replace(
        _merging("mv-mwm", MERGES["mv-mwm"]),
        summary="MV-MWM: a world model on a masked autoencoder over views, which views are present "
        "drawn uniformly; actor and critic learn in its imagination",
        subsets=_every_other_subset,
        weights=lambda alpha: {"every": 1.0},
        recipes=("mv-mwm",),
    ),
}


def label_of(spec: PolicySpec) -> str:
    """The name of a policy beside others of its task: ``MAD``, ``Merged Only``."""
    name = spec.method.upper() if len(spec.method) < 4 else spec.method.replace("-", " ").title()
    return name if spec.setting in ("three", "") else f"{name}, {spec.setting}"


def method(name: str) -> Method:
    """The method called ``name``. Raises UserError listing the known ones."""
    if name not in METHODS:
        raise unknown("method", name, list(METHODS))
    return METHODS[name]
