"""Success against displacement: how far may a camera go before a policy notices?

    madviz displace --policy NAME --camera third_a --along right --steps 5 --most 0.2

moves one camera to 0, 0.05, 0.10, 0.15 and 0.20 m from where it stood in training and runs the same
seeds at each place; with ``--both`` also to the left, by as much. All else is as in
``madviz eval``: the numbers at 0 are those of its subset, an episode is a pure function of its
seed, and workers change nothing but the time. Every rate comes with its count and interval; with 20
episodes a rate of 0.5 is known to about 0.2 either way, so two neighbouring points that differ by
less say nothing yet.

Zoom goes from 1 to its end by equal factors, everything else by equal distances. ``--svg`` draws
the curve with its intervals. ``--csv`` writes a row for each place that says all of itself, so that
the tables of several cameras and policies can be put one after the other.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NotRequired, TypedDict

import numpy as np

from madviz.errors import UserError, saving, unknown
from madviz.measure.episodes import FIRST_SEED, clipped_words, unsupported
from madviz.measure.statistics import SuccessRate
from madviz.measure.table import Table, seeds_of_run
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, along
from madviz.plots.figures import Line, lines
from madviz.policies import checkpoint
from madviz.policies.measured import RateRow
from madviz.subsets import cameras_of, mask_of, name_of
from madviz.system.files import write_bytes, written_to
from madviz.system.numbers import Count, Distance, Seed, ThreadsOrNone
from madviz.types import Policy

Direction = Literal["forward", "right", "up", "pan", "tilt", "zoom"]
WAYS = {
    "forward": ("forward", "back"),
    "right": ("right", "left"),
    "up": ("up", "down"),
    "pan": ("right", "left"),
    "tilt": ("up", "down"),
    "zoom": ("in", "out"),
}
"""The words for more and less of a direction."""
UNITS = {"forward": "m", "right": "m", "up": "m", "pan": "°", "tilt": "°", "zoom": "times"}
FARTHEST = {"m": 0.2, "°": 20.0, "times": 1.5}
"""The last place by its unit, the default of ``--most``."""
MOST_POINTS = 50


@dataclass(frozen=True)
class DisplaceConfig:
    """Counts a policy's successes while one camera moves away from where it was trained."""

    policy: checkpoint.PolicyName
    """A name of a policy, its folder, or module:factory."""
    camera: str
    """The camera that moves, for example third_a."""
    along: Direction = "right"
    """The camera's own axes as it stood in training: right is the picture's right."""
    steps: Count = 5
    """Places, the first of which is where it was trained."""
    most: Distance | None = None
    """The last place: metres (0.2 by default), degrees (20), or times for zoom (1.5); negative, or
    below 1 for zoom, goes the other way."""
    both: bool = False
    """Also the other way, to as many places as far away."""
    episodes: Count = 20
    """Episodes at each place."""
    seed: Seed = FIRST_SEED
    """The first episode's seed; the others count up, the same at every place."""
    subset: str = "all"
    """The streams that are present; the camera must be among them."""
    workers: ThreadsOrNone | None = None
    """Processes; by default one per core. 0 runs everything in this one."""
    svg: Path | None = None
    """Where to draw the curve."""
    csv: Path | None = None
    """Where to write a table with a row for each place."""
    json: str | None = None
    """Where to write the result; - is standard output."""


@dataclass(frozen=True)
class Point:
    """Success with the camera at one place."""

    at: float
    """Metres, degrees or times."""
    success: SuccessRate
    outside: float = 0.0
    """The share of action numbers outside [-1, 1]; they were clipped."""


def places(
    direction: str, most: float, steps: int, both: bool = False
) -> dict[float, Displacement]:
    """``steps`` moves by how far they go, from none to ``most``; ``both`` ways, from the farthest
    of the one side to the farthest of the other. Raises UserError for an unknown direction, a
    range of no length and a place that is too far."""
    count = 2 * steps - 1 if both else steps
    if not (steps >= 2 and count <= MOST_POINTS):
        raise UserError(f"expected 2 to {MOST_POINTS} places, found {count}; say so with --steps")
    along(direction, most)
    start = 1.0 if direction == "zoom" else 0.0
    if most == start:
        raise UserError(
            f"expected --most to lead away from {start:g}, found {most:g}; give another"
        )
    zooms = direction == "zoom"
    values = np.geomspace(1.0, most, steps) if zooms else np.linspace(0.0, most, steps)
    if both:
        values = np.r_[(1 / values if zooms else -values)[:0:-1], values]
    return {value: along(direction, value) for value in (round(float(v), 6) for v in values)}


def displace(
    policy: str | Path | Policy,
    camera: str,
    moves: dict[float, Displacement],
    *,
    subset: str = "all",
    episodes: int = 20,
    seed: int = FIRST_SEED,
    workers: int | None = None,
    progress: bool = False,
) -> tuple[Point, ...]:
    """Runs the seeds ``seed`` to ``seed + episodes - 1`` with ``camera`` at each of ``moves``.

    ``policy``, ``workers`` and the rest as in ``madviz.evaluate``. Raises UserError for a camera
    that the policy does not see under ``subset``.
    """
    seeds = seeds_of_run(seed, episodes)
    table, loaded = Table.opened(policy)
    subset = _checked(loaded, subset, camera)
    conditions = {
        at: Condition(subset, (), ((camera, move),)).noticed(loaded.spec.streams)
        for at, move in moves.items()
    }
    table.play([(c, s) for c in conditions.values() for s in seeds], workers, progress)
    return tuple(
        Point(
            at,
            SuccessRate.counted(table.outcomes(condition).values()),
            table.outside([condition]),
        )
        for at, condition in conditions.items()
    )


def _checked(policy: Policy, subset: str, camera: str) -> str:
    """The subset's canonical name, if the policy can act on it and ``camera`` is in it."""
    streams = policy.spec.streams
    mask = mask_of(subset, streams)
    if not policy.supports(mask):
        raise unsupported(policy.spec, mask)
    present = cameras_of(tuple(s for s, on in zip(streams, mask, strict=True) if on))
    if camera not in present:
        raise unknown(f"camera to move under the subset {subset!r}:", camera, list(present))
    return name_of(mask, streams)


# --- The command ----------------------------------------------------------------------------


class PointRow(RateRow):
    """Success with the camera at one place, as the document holds it."""

    at: float
    successes: int
    outside: NotRequired[float]
    """The share of action numbers outside [-1, 1]; they were clipped."""


class DisplaceFile(TypedDict):
    """The document that ``madviz displace --json`` writes."""

    schema: int
    policy: str
    digest: str
    task: str
    camera: str
    along: str
    unit: str
    """``m``, ``°`` or ``times``."""
    subset: str
    seed: int
    points: list[PointRow]


def run_displace(config: DisplaceConfig) -> DisplaceFile:
    """``madviz displace``: always computes; progress goes to standard error."""
    for name in ("svg", "csv"):
        file: Path | None = getattr(config, name)
        if file is not None:
            written_to(file, f"--{name}")
    spec = checkpoint.load_policy(config.policy).spec
    most = FARTHEST[UNITS[config.along]] if config.most is None else config.most
    points = displace(
        config.policy,
        config.camera,
        places(config.along, most, config.steps, config.both),
        subset=config.subset,
        episodes=config.episodes,
        seed=config.seed,
        workers=config.workers,
        progress=True,
    )
    result: DisplaceFile = {
        "schema": 1,
        "policy": spec.name,
        "digest": spec.digest,
        "task": spec.task,
        "camera": config.camera,
        "along": config.along,
        "unit": UNITS[config.along],
        "subset": config.subset,
        "seed": config.seed,
        "points": [
            {
                "at": point.at,
                "successes": point.success.successes,
                "outside": point.outside,
                **point.success.row(),
            }
            for point in points
        ],
    }
    if config.svg is not None:
        with saving(result, f"--svg {config.svg}"):
            write_bytes(config.svg, picture(result).encode())
    if config.csv is not None:
        with saving(result, f"--csv {config.csv}"):
            write_bytes(config.csv, table_csv(result).encode())
    return result


def table_csv(result: DisplaceFile) -> str:
    """A row for each place, with all that sets it apart from rows of other files."""
    facts = {key: result[key] for key in ("policy", "digest", "task", "subset", "seed", "camera")}
    facts |= {key: result[key] for key in ("along", "unit")}
    file = io.StringIO()
    numbers = ("at", "successes", "n", "success", "ci95_low", "ci95_high")
    writer = csv.DictWriter(file, [*facts, *numbers], lineterminator="\n")
    writer.writeheader()
    for point in result["points"]:
        low, high = point["ci95"]
        measured = {name: point[name] for name in numbers[:4]}
        writer.writerow({**facts, **measured, "ci95_low": low, "ci95_high": high})
    return file.getvalue()


def displacement_table(result: DisplaceFile) -> str:
    """The result as lines: place, success with its interval, episodes."""
    rows = [
        f"{result['policy']} on {result['task']}, subset {result['subset']}: success at the last "
        f"step with {result['camera']} moved along its {result['along']}"
    ]
    for point in result["points"]:
        place = f"{point['at']:g} {result['unit']}"
        rows.append(f"  {place:12} {SuccessRate.read(point)}")
    shares = [point.get("outside", 0.0) for point in result["points"]]
    rows += filter(None, [clipped_words(sum(shares) / len(shares))])
    return "\n".join(rows)


def picture(result: DisplaceFile) -> str:
    """SVG: the rate over how far the camera went, in the axis' own unit, and its interval."""
    points = result["points"]
    start = 1.0 if result["unit"] == "times" else 0.0
    # The axis begins at nothing, and zoom at 1; it says centimetres, because it has no decimals.
    scale, unit = (100, "cm") if result["unit"] == "m" else (1, result["unit"])
    if result["unit"] == "times":
        scale = 100
        unit = "% more or less"
    curves = {}
    for sign, way in zip((1, -1), WAYS[result["along"]], strict=True):
        side = [p for p in points if sign * (p["at"] - start) >= 0]
        if len(side) > 1:
            side.sort(key=lambda p: abs(p["at"] - start))
            curves[f"{result['subset']}, {way}"] = Line(
                [abs(p["at"] - start) * scale for p in side],
                [p["success"] for p in side],
                *([p["ci95"][end] for p in side] for end in (0, 1)),
            )
    title = f"{result['policy']}: {result['camera']} moved, n={points[0]['n']} at each place"
    return lines(title, unit, {result["along"]: curves})
