"""``python -m madviz.measure.guard_trial OUT``: what guards are worth, over policies and failures.

Every camera of every policy fails in every way of ``WAYS``, and the same seeds are played with the
camera broken, broken with a guard, and dropped; and intact, with the guard and without. Episodes
are kept in OUT/episodes.sqlite as they finish, so that a run that was stopped goes on. The result,
OUT/guard.json and lines on standard output, has for each policy, camera and way the three rates.
"""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import TypedDict

from madviz.measure.statistics import SuccessRate
from madviz.measure.store import Store
from madviz.measure.table import Table
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_condition
from madviz.policies.guarded import with_guard
from madviz.policies.seeds import FIRST_DEVELOPMENT, seeds_from
from madviz.subsets import cameras_of
from madviz.system.files import write_json

WAYS = ("black", "freeze", "dropout:0.5", "noise", "delay:0.5", "blur", "patch")


class TrialRow(TypedDict):
    """One way in which one camera fails; '' and '' are the intact episodes."""

    policy: str
    camera: str
    way: str
    broken: float
    guarded: float
    dropped: float
    n: int


def trial(policies: list[str], seeds: range, out: Path, workers: int | None) -> list[TrialRow]:
    """Plays what is missing. Raises UserError for a policy without fitted values."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[TrialRow] = []
    with closing(Store(out / "episodes.sqlite")) as store:
        for name in policies:
            rows += _of_policy(name, seeds, store, workers)
            write_json(out / "guard.json", {"schema": 1, "seeds": list(seeds), "rows": rows})
    return rows


def _of_policy(name: str, seeds: range, store: Store, workers: int | None) -> list[TrialRow]:
    bare, policy = Table.opened(name, store, own=True)
    guarded, _ = Table.opened(with_guard(name, True), store, own=True)
    streams = policy.spec.streams
    cameras = cameras_of(streams)
    intact = Condition("all").noticed(streams)
    rows = [_row(name, ("", ""), (bare, intact), (guarded, intact), (bare, intact), seeds, workers)]
    for camera in cameras:
        rest = Condition("+".join(one for one in cameras if one != camera) or "none")
        for way in WAYS:
            fails = parse_condition(f"{camera}={way}", cameras).noticed(streams)
            dropped = bare, rest.noticed(streams)
            what = camera, way
            rows.append(_row(name, what, (bare, fails), (guarded, fails), dropped, seeds, workers))
    return rows


def _row(
    name: str,
    what: tuple[str, str],
    broken: tuple[Table, Condition],
    guarded: tuple[Table, Condition],
    dropped: tuple[Table, Condition],
    seeds: range,
    workers: int | None,
) -> TrialRow:
    rates = []
    for table, condition in (broken, guarded, dropped):
        table.play([(condition, seed) for seed in seeds], workers, progress=True)
        known = table.outcomes(condition)
        rates.append(SuccessRate.counted(known[seed] for seed in seeds))
    row: TrialRow = {
        "policy": name,
        "camera": what[0],
        "way": what[1],
        "broken": rates[0].value,
        "guarded": rates[1].value,
        "dropped": rates[2].value,
        "n": len(seeds),
    }
    place = f"{what[0]} {what[1]}" if what[0] else "intact"
    print(f"{name:40} {place:24}", *[f"{word} {row[word]:.2f}" for word in RATES], flush=True)
    return row


RATES = ("broken", "guarded", "dropped")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Success broken, guarded and dropped.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--policies", nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=FIRST_DEVELOPMENT)
    parser.add_argument("--workers", type=int, default=None)
    words = parser.parse_args()
    seeds = seeds_from(words.seed, words.episodes)
    trial(words.policies, seeds, words.out, words.workers)


if __name__ == "__main__":
    main()
