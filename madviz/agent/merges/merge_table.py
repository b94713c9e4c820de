"""The table of merges: what each can act on, and its words on pages and cards. No torch here.

A new merge is a file, beside this one or elsewhere, and a row here that names its class. Methods,
pages, cards, reports and evaluations ask this table, so that "cannot act without this camera" is a
fact of a merge and not a special case anywhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from madviz.agent.sizes import OwnOptions
from madviz.errors import UserError, unknown
from madviz.subsets import cameras_of
from madviz.system.plugins import load
from madviz.types import Array

if TYPE_CHECKING:
    from madviz.agent.merges.base import Merge


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
    """A setting must have these before something can be trained on it."""

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
            wanted = f"{self.cameras} or more cameras"
            found = ", ".join(cameras)
        elif self.camera and self.camera not in cameras:
            wanted = f"the camera {self.camera!r}"
            found = ", ".join(cameras)
        else:
            return
        raise UserError(
            f"expected a setting with {wanted}, found {found}; pick another setting or method"
        )


SEVERAL_STREAMS = Needs(streams=2, words=("two or more streams",))


@dataclass(frozen=True)
class MergeFacts:
    """One row: the facts of a merge."""

    summary: str
    network: str
    """Its class, module:name."""
    support: Support
    page_words: str = ""
    """A sentence for visitors of the page about the method that merges so and does nothing else."""
    cell_words: str = ""
    """Its work in the words of a table's cell; empty: the page tells it from the numbers."""
    needs: Needs = Needs()
    options: str = ""
    """The class of its own options, module:name; empty: it has none."""
    sizes: tuple[str, ...] = ()
    """Those of its options that its networks are built from: config.json has them, too, beside the
    sizes of ``NetworkConfig``, so they need other names."""
    own_loss: bool = False
    """True where the merge adds a loss or a penalty of its own; then it serves no other method."""
    costly_rows: bool = False
    """Whether a row costs as much as encoding: rows are kept where they would be made again, and a
    page reads the subsets that it is asked for."""
    trains_each_alone: bool = False
    """Whether training on all streams is often training on one, because streams are drawn."""


MERGES: dict[str, MergeFacts] = {
    "sum": MergeFacts("features are summed", "madviz.agent.merges.sum:Sum", ANY),
    "concat": MergeFacts(
        "features side by side",
        "madviz.agent.merges.concat:Concat",
        ALL,
        page_words="Features side by side: cannot act without any camera.",
        cell_words="side by side",
    ),
    "frame-stack": MergeFacts(
        "pixels stacked before one encoder",
        "madviz.agent.merges.frame_stack:FrameStack",
        ALL,
        page_words="All cameras' pixels in one encoder: cannot act without any.",
        cell_words="one feature of all pictures",
    ),
    "attention": MergeFacts(
        "features attend to each other, then summed",
        "madviz.agent.merges.attention:CrossAttention",
        SOME,
        page_words="Cameras' features attend to each other; trained on all together.",
        cell_words="by attention, then summed",
    ),
    "vit": MergeFacts(
        "one token per view through a transformer layer",
        "madviz.agent.merges.vit:ViewTransformer",
        SOME,
        page_words="One token per camera in a transformer layer; trained on all together.",
        cell_words="by a transformer layer",
    ),
    "q-mean": MergeFacts(
        "every view judged alone, actions and Q averaged",
        "madviz.agent.merges.q_mean:QMean",
        SOME,
        page_words="Every camera judged alone, actions and Q averaged; trained on all together.",
    ),
    "mvd": MergeFacts(
        "multi-view disentanglement: shared and private parts, separated by contrast",
        "madviz.agent.merges.mvd:TwoPartEncoder",
        SOME,
        page_words="MVD: acts on a shared part of one camera and a private part of another.",
        cell_words="halves of two cameras, drawn",
        needs=SEVERAL_STREAMS,
        own_loss=True,
        trains_each_alone=True,
    ),
    "vib": MergeFacts(
        "variational information bottleneck on every view but the first person's",
        "madviz.agent.merges.vib:BottleneckEncoder",
        ALL_OR_ONE,
        page_words="VIB: third-person cameras pass a noisy bottleneck; all cameras, or one.",
        cell_words="side by side, narrowed",
        needs=Needs(
            cameras=2, camera="first", words=("the camera first", "one or more other cameras")
        ),
        options="madviz.agent.merges.vib:VibOptions",
        sizes=("bottleneck_dim",),
        own_loss=True,
    ),
    "mv-mae": MergeFacts(
        "tokens of a masked autoencoder over views, which learns to draw all of them from some",
        "madviz.world_model.mv_mae:TokenNetworks",
        SOME,
        page_words="MV-MAE: acts on a network that learned to draw every camera from the others.",
        cell_words="tokens of an autoencoder",
        needs=SEVERAL_STREAMS,
        options="madviz.world_model.sizes:MvMaeOptions",
        sizes=("autoencoder", "end_to_end"),
        own_loss=True,
        costly_rows=True,
    ),
    "mv-mwm": MergeFacts(
        "a world model's belief over the tokens of a masked autoencoder over views",
        "madviz.world_model.mv_mwm:WorldNetworks",
        SOME,
        page_words="MV-MWM: learned to act in what a world model imagines.",
        cell_words="a belief over tokens of an autoencoder",
        needs=SEVERAL_STREAMS,
        options="madviz.world_model.sizes:MvMwmOptions",
        sizes=("autoencoder", "world_model"),
        own_loss=True,
        costly_rows=True,
    ),
}


def merge_class(name: str) -> type[Merge]:
    """The module of the merge called ``name``; loads torch. Raises UserError listing the known."""
    if name not in MERGES:
        raise unknown("merge", name, list(MERGES))
    return load(MERGES[name].network)


def own_options(name: str) -> type[OwnOptions]:
    """The class of the options that the merge called ``name`` has and no other; ``OwnOptions``
    itself where it has none."""
    return load(MERGES[name].options) if MERGES[name].options else OwnOptions
