"""The table of merges: what each can act on, and its words on pages and cards. No torch here.

A new merge is a file beside this one (``merge_functions`` says its name) and a row here. Methods,
pages, cards, reports and evaluations ask this table, so that "cannot act without this camera" is a
fact of a merge and not a special case anywhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from madviz.errors import UserError, unknown
from madviz.subsets import cameras_of
from madviz.types import Array

if TYPE_CHECKING:
    from madviz.agent.merges.base import MergeFunctions


@dataclass(frozen=True)
class Support:
    """Which subsets a merge can act on."""

    words: str
    allows: Callable[[Array], bool]
    """A mask (V,) bool -> whether a feature can be formed from the streams that are present."""


ANY = Support("any subset, the empty one included", lambda mask: True)
SOME = Support("any subset with at least one stream", lambda mask: bool(np.any(mask)))
ALL = Support("all streams together, and nothing less", lambda mask: bool(np.all(mask)))
ALL_OR_ONE = Support(
    "all streams together, or one alone", lambda mask: bool(np.all(mask) or np.sum(mask) == 1)
)


@dataclass(frozen=True)
class Needs:
    """What a setting must have before something can be trained on it."""

    streams: int = 1
    cameras: int = 1
    camera: str = ""
    """A camera that must be there."""
    words: tuple[str, ...] = ()
    """The same for ``madviz list``."""

    def check(self, streams: tuple[str, ...]) -> None:
        """Raises UserError where a setting's ``streams`` are too few."""
        cameras = cameras_of(streams)
        if len(streams) < self.streams:
            wanted = f"{self.streams} or more streams"
            found = f"{len(streams)} ({', '.join(streams)})"
        elif len(cameras) < self.cameras:
            wanted, found = f"{self.cameras} or more cameras", ", ".join(cameras)
        elif self.camera and self.camera not in cameras:
            wanted, found = f"the camera {self.camera!r}", ", ".join(cameras)
        else:
            return
        raise UserError(
            f"expected a setting with {wanted}, found {found}; pick another setting or method"
        )


SEVERAL_STREAMS = Needs(streams=2, words=("two or more streams",))


@dataclass(frozen=True)
class Merge:
    """One row: the facts of a merge. What it computes is in the file of its name."""

    summary: str
    support: Support
    page_words: str = ""
    """A sentence for visitors of the page about the method that merges so and does nothing else."""
    cell_words: str = ""
    """What it does, in the words of a table's cell; empty: the page tells it from the numbers."""
    needs: Needs = Needs()
    own_loss: bool = False
    """Whether it brings a loss, and therefore is a method of its own and serves no other."""
    costly_rows: bool = False
    """Whether a row costs as much as encoding: rows are kept where they would be made again, and a
    page reads the subsets that it is asked for."""
    trains_each_alone: bool = False
    """Whether training on all streams is often training on one, because streams are drawn."""


MERGES: dict[str, Merge] = {
    "sum": Merge("features are summed", ANY),
    "concat": Merge(
        "features side by side",
        ALL,
        page_words="Features side by side: cannot act without any camera.",
        cell_words="side by side",
    ),
    "frame-stack": Merge(
        "pixels stacked before one encoder",
        ALL,
        page_words="All cameras' pixels in one encoder: cannot act without any.",
        cell_words="one feature of all pictures",
    ),
    "attention": Merge(
        "features attend to each other, then summed",
        SOME,
        page_words="Cameras' features attend to each other; trained on all together.",
        cell_words="by attention, then summed",
    ),
    "vit": Merge(
        "one token per view through a transformer layer",
        SOME,
        page_words="One token per camera in a transformer layer; trained on all together.",
        cell_words="by a transformer layer",
    ),
    "q-mean": Merge(
        "every view judged alone, actions and Q averaged",
        SOME,
        page_words="Every camera judged alone, actions and Q averaged; trained on all together.",
    ),
    "mvd": Merge(
        "multi-view disentanglement: shared and private parts, separated by contrast",
        SOME,
        page_words="MVD: acts on a shared part of one camera and a private part of another.",
        cell_words="halves of two cameras, drawn",
        needs=SEVERAL_STREAMS,
        own_loss=True,
        trains_each_alone=True,
    ),
    "vib": Merge(
        "variational information bottleneck on every view but the first person's",
        ALL_OR_ONE,
        page_words="VIB: third-person cameras pass a noisy bottleneck; all cameras, or one.",
        cell_words="side by side, narrowed",
        needs=Needs(
            cameras=2, camera="first", words=("the camera first", "one or more other cameras")
        ),
        own_loss=True,
    ),
    "mv-mae": Merge(
        "tokens of a masked autoencoder over views, which learns to draw all of them from some",
        SOME,
        page_words="MV-MAE: acts on a network that learned to draw every camera from the others.",
        cell_words="tokens of an autoencoder",
        needs=SEVERAL_STREAMS,
        own_loss=True,
        costly_rows=True,
    ),
    "mv-mwm": Merge(
        "a world model's belief over the tokens of a masked autoencoder over views",
        SOME,
        page_words="MV-MWM: learned to act in what a world model imagines.",
        cell_words="a belief over tokens of an autoencoder",
        needs=SEVERAL_STREAMS,
        own_loss=True,
        costly_rows=True,
    ),
}


@cache
def merge_functions(name: str) -> MergeFunctions:
    """What the merge called ``name`` computes: ``FUNCTIONS`` of ``madviz/agent/merges/NAME.py``.

    Loads torch, and nothing else here does. Raises UserError listing the known ones.
    """
    if name not in MERGES:
        raise unknown("merge", name, list(MERGES))
    return import_module(f"madviz.agent.merges.{name.replace('-', '_')}").FUNCTIONS
