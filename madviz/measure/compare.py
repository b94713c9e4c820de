"""``madviz compare A B``: which policy is better, by the episodes they have in common.

Two policies that met the same seeds are compared scene by scene: where both succeed or both fail, a
scene says nothing about which is better. With 100 scenes, 12 of which only A solves and 2 only B,

    A - B   +0.10   95% interval [+0.03, +0.18]   exact p = 0.013

(Newcombe's interval for paired rates, McNemar's test). Policies that did not meet the same seeds
are refused: the difference could come from easier scenes. Several policies are each
compared with the first. The figure shows every method with its trainings: bars are means, dots are
trainings; with ``--curves``, success against environment steps where the recipe measured it on the
way. With ``--conditions``, conditions of one policy are compared instead
(``compare_conditions.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NotRequired, TypedDict

from madviz.errors import UserError
from madviz.measure.compare_conditions import ConditionsFile, compare_conditions, conditions_table
from madviz.measure.compare_figures import bars, curves
from madviz.measure.compare_page import write_comparison
from madviz.measure.episodes import FIRST_SEED, clipped_words
from madviz.measure.evidence import Evidence, Outcomes, alike, readable
from madviz.measure.statistics import PairedRow, pair
from madviz.measure.store import EpisodeResult, ResultKey, Store, is_store
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.listing import BrokenRow
from madviz.policies.sb3 import trust
from madviz.policies.seeds import use_of
from madviz.subsets import mask_of, name_of
from madviz.system.files import write_bytes, written_to
from madviz.system.numbers import Count, Seed, ThreadsOrNone
from madviz.wire.reference import with_wire


@dataclass(frozen=True)
class CompareConfig:
    """Compares policies with the first one, on the seeds they all met."""

    policies: tuple[checkpoint.PolicyName, ...]
    """Two or more names of policies, or their folders; with ``--conditions``, one policy."""
    subset: tuple[str, ...] = ()
    """For example ``all first``; by default every subset that all of them were measured on."""
    store: str | None = None
    """Take episodes from this store of results and not from evaluation.json."""
    figure: Path | None = None
    """Write success by method and subset to this SVG file."""
    curves: Path | None = None
    """Write success against environment steps to this SVG file; recipe ``paper`` measures it."""
    page: Path | None = None
    """Write a page with episodes that came out differently to this HTML file, as films."""
    wire: Path | None = None
    """With ``--conditions`` and ws://HOST:PORT: how its names and shapes map to ours."""
    conditions: tuple[str, ...] = ()
    """Compare conditions of one policy, for example ``all third_a=black first=delay``: subsets
    of cameras, and failures of whole episodes or from a step on (``first=freeze@20``). They are
    played now, with the options below."""
    guard: bool = False
    """With ``--conditions``: a camera that the guard finds failing is left out."""
    trust: bool = False
    """With ``--conditions``: loads the file of sb3:FILE@TASK, which runs what is in it."""
    episodes: Count = 50
    """Episodes of each condition."""
    seed: Seed = FIRST_SEED
    """The first episode's seed; the same for every condition."""
    workers: ThreadsOrNone | None = None
    """Processes; by default one per core. 0 runs everything in this one."""
    json: str | None = None
    """Where to write the result; - is standard output."""


class ComparedPolicy(TypedDict):
    """A policy that was compared."""

    name: str
    path: str
    method: str
    seed: int
    """The seed of its training."""
    outside: NotRequired[float]
    """The share of its action numbers outside [-1, 1] on the compared subsets; they were
    clipped."""


class RatesRow(PairedRow):
    """Two policies on one subset; ``first`` and ``second`` are their success rates."""

    first: float
    second: float
    seeds: tuple[int, int]
    """The first and the last one."""
    use: str
    """The use of these seeds, such as reporting."""


class ComparisonRow(TypedDict):
    """The first policy against another one, as they are named on the command line."""

    first: str
    second: str
    subsets: dict[str, RatesRow]


class CompareFile(TypedDict):
    """The document that ``madviz compare --json`` writes."""

    schema: int
    task: str
    definition: str
    policies: list[ComparedPolicy]
    comparisons: list[ComparisonRow]
    broken: list[BrokenRow]


def run_compare(config: CompareConfig) -> CompareFile | ConditionsFile:
    """``madviz compare``. Raises UserError for what cannot be compared."""
    return _conditions(config) if config.conditions else compare_policies(config)


def compare_policies(config: CompareConfig) -> CompareFile:
    """Compares policies by their measured episodes. One whose files are broken is named and left
    out, unless it is the first. Raises UserError for policies that cannot be compared."""
    _check_options(config)
    folders = [checkpoint.find_policy(name) for name in config.policies]
    policies, broken = readable(folders)
    if len(policies) < 2 or policies[0].path != folders[0]:
        raise UserError(f"nothing to compare: {'; '.join(map(_broken_line, broken))}")
    shared = alike(policies)
    if len(shared) == len(policies):
        policies = shared
    first = policies[0]
    for other in policies[1:]:
        _same_terms(first, other)
    store = None if config.store is None else _opened(config.store)
    table = _outcomes(policies, config.subset, store)
    for name, rows in table.items():
        for other, outcomes in zip(policies, rows, strict=True):
            _same_seeds(name, first, rows[0], other, outcomes)
    if config.figure is not None:
        write_bytes(config.figure, bars(policies, table).encode())
    if config.curves is not None:
        write_bytes(config.curves, curves(policies).encode())
    found: CompareFile = {
        "schema": 1,
        "task": first.config.task,
        "definition": first.config.definition,
        "policies": [
            {
                "name": e.config.name,
                "path": str(e.path),
                "method": e.config.method,
                "seed": e.seed,
                "outside": _outside(e, list(table), store),
            }
            for e in policies
        ],
        "comparisons": [
            {
                "first": config.policies[0],
                "second": config.policies[folders.index(policies[index].path)],
                "subsets": {name: _row(rows[0], rows[index]) for name, rows in table.items()},
            }
            for index in range(1, len(policies))
        ],
        "broken": broken,
    }
    if config.page is not None:
        title = f"{found['task']}: policies compared"
        write_comparison(config.page, title, comparison_table(found), policies, table)
    return found


def _check_options(config: CompareConfig) -> None:
    """Raises UserError for what is about conditions, and for policies without episodes."""
    usual = CompareConfig(config.policies)
    for name in ("guard", "wire", "trust", "episodes", "seed", "workers"):
        if getattr(config, name) != getattr(usual, name):
            raise UserError(
                f"expected --conditions beside --{name}, found none; add them, or leave it out: "
                "policies are compared on episodes that were played before"
            )
    if len(config.policies) < 2:
        raise UserError(f"expected two or more policies, found {len(config.policies)}")
    _check_files(config)
    if own := [name for name in config.policies if not checkpoint.is_folder(name)]:
        raise UserError(
            f"expected policies with measured episodes in a folder, found {own[0]!r:.100}, which "
            "has none; compare its --conditions"
        )


def _check_files(config: CompareConfig) -> None:
    for name in ("figure", "curves", "page"):
        file: Path | None = getattr(config, name)
        if file is not None:
            written_to(file, f"--{name}")


def _conditions(config: CompareConfig) -> ConditionsFile:
    if len(config.policies) != 1:
        raise UserError(f"expected one policy with --conditions, found {len(config.policies)}")
    _check_files(config)
    for name in ("subset", "store", "figure", "curves"):
        if getattr(config, name):
            raise UserError(f"--{name} is about policies; leave it out, or --conditions")
    trust(config.policies[0], config.trust)
    return compare_conditions(
        with_guard(with_wire(config.policies[0], config.wire), config.guard),
        config.conditions,
        episodes=config.episodes,
        seed=config.seed,
        workers=config.workers,
        page=config.page,
    )


def _broken_line(row: BrokenRow) -> str:
    return f"{row['name']} broken: {row['error']}"


def _row(first: Outcomes, second: Outcomes) -> RatesRow:
    paired = pair(first, second)
    return {
        "first": (paired.both + paired.first_only) / paired.n,
        "second": (paired.both + paired.second_only) / paired.n,
        "seeds": (min(first), max(first)),
        "use": use_of(first),
        **paired.row(),
    }


def _same_terms(first: Evidence, other: Evidence) -> None:
    for fact, mine, theirs in (
        ("task", first.config.task, other.config.task),
        ("definition", first.config.definition, other.config.definition),
        ("render profile", first.config.render_profile, other.config.render_profile),
        ("occlusions", first.occlusions, other.occlusions),
    ):
        if mine != theirs:
            raise UserError(
                f"expected policies measured alike, found {fact} {mine!r} of "
                f"{first.path} and {theirs!r} of {other.path}; nothing could be compared"
            )


def _same_seeds(
    subset: str, first: Evidence, mine: Outcomes, other: Evidence, theirs: Outcomes
) -> None:
    if mine.keys() != theirs.keys():
        raise UserError(
            f"expected the same seeds for {subset}, found {spans(mine)} of {first.path} and "
            f"{spans(theirs)} of {other.path}; run `madviz eval --card` on both with the same "
            "--seed and --episodes"
        )


def spans(seeds: Outcomes) -> str:
    """``5000-5099 (100)``."""
    return f"{min(seeds)}-{max(seeds)} ({len(seeds)})" if seeds else "none"


def _outcomes(
    found: Sequence[Evidence], subsets: Sequence[str], store: Store | None
) -> dict[str, list[Outcomes]]:
    """Outcomes of every policy by subset. Raises UserError where one was not measured."""
    table: dict[str, list[Outcomes]] = {}
    for name in subsets or found[0].outcomes:
        rows = [e.of(name) if store is None else _successes(store, e, name) for e in found]
        lacking = [str(e.path) for e, row in zip(found, rows, strict=True) if not row]
        if not lacking:
            table[name] = [row for row in rows if row]
        elif subsets:
            raise UserError(
                f"expected episodes on {name!r} of every policy, found none of "
                f"{', '.join(lacking)}; run `madviz eval --policy {lacking[0]} --subsets {name}"
                " --card`"
            )
    if not table:
        raise UserError("expected a subset that all policies were measured on, found none")
    return table


def _opened(path: str) -> Store:
    if not is_store(Path(path)):
        found = "another file" if Path(path).exists() else "none"
        raise UserError(f"{path}: expected a store of results, found {found}; leave --store out")
    return Store(path)


def _outside(evidence: Evidence, subsets: Sequence[str], store: Store | None) -> float:
    """The share of a policy's action numbers outside [-1, 1], on average over ``subsets``."""
    if store is None:
        names = [evidence.name_there(subset) for subset in subsets]
        shares = [evidence.outside[name] for name in names if name is not None]
    else:
        found = [_stored(store, evidence, subset) for subset in subsets]
        shares = [result.outside for results in found for result in results.values()]
    return sum(shares) / len(shares)


def _successes(store: Store, evidence: Evidence, subset: str) -> Outcomes:
    results = _stored(store, evidence, subset)
    return {seed: result.success for seed, result in results.items()}


def _stored(store: Store, evidence: Evidence, subset: str) -> dict[int, EpisodeResult]:
    config = evidence.config
    digest = checkpoint.describe(evidence.path).spec.digest
    try:
        name = name_of(mask_of(subset, config.streams), config.streams)
    except UserError:
        return {}  # A camera that this policy does not have.
    facts = (config.task, config.definition, config.render_profile, "", name)
    return store.results(ResultKey(digest, *facts))


def comparison_table(result: CompareFile | ConditionsFile) -> str:
    """A comparison as lines."""
    if "conditions" in result:
        return conditions_table(result)
    lines = [f"{result['task']}: success {result['definition']}"]
    for comparison in result["comparisons"]:
        lines.append(f"{comparison['first']} minus {comparison['second']}, paired by seed")
        for name, row in comparison["subsets"].items():
            low, high = row["ci95"]
            lines.append(
                f"  {name:24} {row['first']:.2f} - {row['second']:.2f} = {row['difference']:+.2f} "
                f"[{low:+.2f}, {high:+.2f}] n={row['n']}   exact p = {row['p']:.2g}   "
                f"seeds {'-'.join(map(str, row['seeds']))}, {row['use']}"
            )
    for policy in result["policies"]:
        if said := clipped_words(policy.get("outside", 0.0)):
            lines.append(f"{policy['name']}: {said}")
    lines += [_broken_line(row) for row in result["broken"]]
    return "\n".join(lines)
