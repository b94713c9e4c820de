"""One table for each question: who is in it, under which name, and which rates it compares.

A label names the row that a policy belongs to, or leaves it out of the table. What a method has as
usual is not said: ``mad`` is MAD with a sum under the light recipe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from madviz.agent.merges import merge_table
from madviz.measure.evidence import Evidence

THREE = ("all", "first", "third_a", "third_b")
MERGES = tuple(name for name, merge in merge_table.MERGES.items() if not merge.own_loss)
"""The merges that the paper compares by themselves, in its order."""
COMPONENTS = ("naive-both", "merged-only", "singular-only")
"""The methods that leave out a component of MAD."""
ORDER = ("mad", "single", "mvd", "vib", "mv-mae", "mv-mwm", *COMPONENTS, *MERGES)
"""The order of rows in every table."""

Label = Callable[[Evidence], str | None]
"""Gives the row that a policy belongs to; None leaves it out of the table."""


@dataclass(frozen=True)
class Layout:
    """See the module."""

    key: str
    title: str
    question: str
    """The heading of its section."""
    label: Label
    columns: tuple[str, ...]
    mean: bool = False
    """Whether a last column has the mean of all others."""
    needs: int = 1
    """Rows without which a task would compare nothing, and stays out."""
    alphas: Literal["usual", "named", "all"] = "usual"
    """Where policies go that differ from a method's usual alpha: out of the table, into rows that
    name it, or into those that ``label`` tells apart itself."""


def _with_recipe(name: str, evidence: Evidence) -> str:
    recipe = evidence.config.recipe
    return name if recipe == "light" else f"{name}, {recipe}"


def _method(evidence: Evidence) -> str:
    """The method, and what of it is not as usual."""
    return _with_recipe(evidence.method, evidence)


def _in(setting: str, *methods: str) -> Label:
    """The label of policies of one setting, of ``methods`` if any are given; those that only
    compare merges have a table of their own."""

    def label(evidence: Evidence) -> str | None:
        name = evidence.config.method
        merging = name in MERGES or (name == "merged-only" and evidence.config.merge != "sum")
        wanted = evidence.config.setting == setting and (not methods or name in methods)
        return _method(evidence) if wanted and not merging else None

    return label


def _overall(evidence: Evidence) -> str | None:
    """All methods with three cameras that imitate, and Single Camera, whose setting may be
    ``one-rgb``, too."""
    return _three(evidence) if evidence.config.recipe == "light" else None


def _scratch(evidence: Evidence) -> str | None:
    return None if evidence.config.recipe == "light" else _three(evidence)


def _three(evidence: Evidence) -> str | None:
    if evidence.config.method == "single" and evidence.config.setting in ("three", "one-rgb"):
        return _method(evidence)
    return _in("three")(evidence)


def _alpha(evidence: Evidence) -> str | None:
    if _in("three", "mad")(evidence) is None or evidence.alpha is None:
        return None
    return _with_recipe(f"alpha {evidence.alpha:g}", evidence)


def _merge(evidence: Evidence, setting: str = "three") -> str | None:
    """The merge of a policy that is trained with all cameras of ``setting`` together."""
    config = evidence.config
    name = config.merge if config.method == "merged-only" else config.method
    known = config.method == "merged-only" or name in MERGES
    return _with_recipe(name, evidence) if known and config.setting == setting else None


def any_method(evidence: Evidence) -> str | None:
    """The row of any policy that imitates with three cameras, however views are merged."""
    return _overall(evidence) or (_merge(evidence) if evidence.config.recipe == "light" else None)


def _modality(evidence: Evidence) -> str | None:
    inside = evidence.config.setting == "three-rgbd" or evidence.config.setting.startswith("one-")
    return f"{_method(evidence)}, {evidence.config.setting}" if inside else None


def _resolution(evidence: Evidence) -> str | None:
    """Pictures of several sizes, and MAD with all of one size beside them."""
    alike = _in("three", "mad")(evidence)
    return _in("mixed-resolution")(evidence) if alike is None else f"{alike}, one size"


LAYOUTS = (
    Layout(
        "overall",
        "Every method",
        "How does MAD compare with the other methods?",
        _overall,
        THREE,
        mean=True,
        needs=2,
    ),
    Layout(
        "scratch",
        "Reinforcement learning from scratch",
        "How far does reinforcement learning come, without an expert?",
        _scratch,
        THREE,
        mean=True,
    ),
    Layout(
        "alpha",
        "Weight of the merged feature, alpha",
        "How much should the sum weigh against the single cameras?",
        _alpha,
        THREE,
        mean=True,
        needs=2,
        alphas="all",
    ),
    Layout(
        "merging",
        "Ways to merge, all cameras",
        "Does the way to merge matter, with all cameras?",
        _merge,
        ("all",),
        needs=2,
    ),
    Layout(
        "merging-two",
        "Ways to merge, two cameras",
        "Does the way to merge matter, with two cameras?",
        partial(_merge, setting="two"),
        ("all",),
        needs=2,
    ),
    Layout(
        "occlusion",
        "Two cameras turned away",
        "What if two of three cameras see nothing?",
        _in("turned-away"),
        ("all", "third_a"),
        alphas="named",
    ),
    Layout(
        "modality",
        "Colour and depth",
        "Colour, depth, or both?",
        _modality,
        ("all", "rgb", "depth"),
    ),
    Layout(
        "five",
        "Five cameras",
        "Does it work with five cameras?",
        _in("five"),
        ("all",),
        mean=True,
    ),
    Layout(
        "resolution",
        "Pictures of several sizes",
        "Does it work with pictures of several sizes?",
        _resolution,
        THREE,
        mean=True,
        needs=2,
    ),
)
"""In the paper's order; its component ablation is in the first. Five cameras: the columns are those
of the policies, see ``build``."""
BASELINES = Layout(
    "methods",
    "Success by method and subset",
    "Which method works from which cameras?",
    any_method,
    THREE,
    needs=5,
)
"""The heat map: tasks on which many methods were trained, however they merge."""


def rank(label: str) -> tuple[int, str]:
    """A row's place in every table: a key to sort labels by."""
    name = label.split(",")[0]
    return (ORDER.index(name) if name in ORDER else len(ORDER), label)
