"""The outcomes of lesson 6: MAD and nine baselines, small on ``toy/reach``, without some cameras.

A camera can be missing in one of two ways. It is *dropped*: the merge does without it. Or it *sends
black*, and the policy takes that for its picture. A merge that has a place for every camera (pixels
or features side by side) knows the second way only. So each method is measured in the same cases:

    all                 what it was trained for
    third_a dropped     two cameras are left, where its merge allows that
    third_a black       three arrive, one of them black
    only third_a        one is left, where its merge allows that

Ten trainings take longer than a lesson, so ``notebooks/baselines.py`` made them once and saved the
outcomes, an episode a digit, seeds counting from 5000. Any two methods can therefore be compared
episode by episode: "1101" and "1100" differ in the last of four.

    {"seed": 5000, "methods": {"vib": {"all": "1101...", "third_a black": "0100...", ...}}, ...}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from madviz.measure.statistics import SuccessRate
from madviz.policies.seeds import FIRST_DEVELOPMENT
from madviz.system.files import read_json, write_json
from madviz.teaching.names import named
from madviz.teaching.show import Figure, TextTable, bars, table

SHIPPED = Path(__file__).with_name("baselines.json")
"""The outcomes that come with the package."""
CAMERAS = ("first", "third_a", "third_b")
COMPARED = (
    "mad",
    "merged-only",
    "q-mean",
    "attention",
    "vit",
    "mvd",
    "vib",
    "concat",
    "frame-stack",
    "single",
)
"""Methods in the order of the tables."""
ROUNDS = 6
UPDATES = 100
"""Rounds and updates of every training, as in lesson 3."""
EPISODES = 40
"""Episodes of every case."""

Outcomes = Mapping[str, str]
"""Case -> a digit for each episode, 1 for success; a case that the policy refuses is missing."""


def cases() -> dict[str, tuple[tuple[str, ...], str]]:
    """Name of a case -> the cameras that are left, and the one of them that sends black."""
    return {
        "all": (CAMERAS, ""),
        **{f"{name} dropped": (tuple(c for c in CAMERAS if c != name), "") for name in CAMERAS},
        **{f"{black} black": (CAMERAS, black) for black in CAMERAS},
        **{f"only {camera}": ((camera,), "") for camera in CAMERAS},
    }


def save_outcomes(file: Path, method: str, outcomes: Outcomes) -> None:
    """Puts the outcomes of ``method`` into ``file``, beside those of other methods."""
    found = {**(read_outcomes(file) if file.exists() else {}), method: dict(outcomes)}
    methods = {name: found[name] for name in COMPARED if name in found}
    budget = {"rounds": ROUNDS, "updates": UPDATES}
    write_json(file, {"task": "toy/reach", **budget, "seed": FIRST_DEVELOPMENT, "methods": methods})


def read_outcomes(file: Path | str = SHIPPED) -> dict[str, dict[str, str]]:
    """Method -> outcomes, as ``notebooks/baselines.py`` measured them."""
    return read_json(Path(file))["methods"]


def one_missing(measured: Mapping[str, Outcomes]) -> dict[str, dict[str, str]]:
    """The outcomes of each method with one camera missing, in the way that suits it: dropped where
    its merge can do without, else black. The cases are called ``first missing`` and so on."""
    found = {}
    for name, outcomes in measured.items():
        found[name] = {"all": outcomes["all"]}
        for camera in CAMERAS:
            black = outcomes[f"{camera} black"]
            found[name][f"{camera} missing"] = outcomes.get(f"{camera} dropped", black)
    return found


def counted(measured: Mapping[str, Outcomes], case: str) -> dict[str, tuple[int, int]]:
    """Method -> (successes, episodes) in ``case``, of those methods that do not refuse it."""
    return {
        name: (outcomes[case].count("1"), len(outcomes[case]))
        for name, outcomes in measured.items()
        if case in outcomes
    }


def by_seed(outcomes: str) -> dict[int, bool]:
    """Digits -> success by seed, for ``statistics.pair`` and ``teaching.paired_table``."""
    return {FIRST_DEVELOPMENT + index: digit == "1" for index, digit in enumerate(outcomes)}


def outcome_table(
    measured: Mapping[str, Outcomes], names: Sequence[str], missing: str = "refuses"
) -> TextTable:
    """A row per method, and its success in each case with interval and count; ``missing`` says why
    there may be none."""
    rows = []
    for method, outcomes in measured.items():
        found = [outcomes.get(name, "") for name in names]
        cells = [str(SuccessRate.of(o.count("1"), len(o))) if o else missing for o in found]
        rows.append([method, *cells])
    return table(["method", *map(named, names)], rows)


def outcome_bars(title: str, measured: Mapping[str, Outcomes], names: Sequence[str]) -> Figure:
    """Success by method with a bar for each case; no bar where the method refuses."""
    counts = {name: counted(measured, name) for name in names}
    series = {named(name): [found.get(m) for m in measured] for name, found in counts.items()}
    return bars(title, list(measured), series)
