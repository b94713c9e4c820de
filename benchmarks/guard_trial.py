"""``benchmarks guard-trial``: success with a guard and without, over policies and failures.

Every camera of every policy, or those of --cameras, fails in every way of --ways. The same seeds
are played with the camera broken, broken with a guard, and dropped; and intact, with the guard and
without. An intact episode in which the guard notices nothing is the same without it, and is played
once. Episodes are kept in episodes.sqlite of --out as they finish, so that a run that was stopped
goes on. trial.json of --out has for each policy, camera and way the three rates, and when it was
noticed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TypedDict

from benchmarks.guard_alarms import GuardAlarmsConfig
from madviz.measure.audit.guarded import alarms_words, noticed_words
from madviz.measure.readings import note_reading, readings
from madviz.measure.statistics import SuccessRate
from madviz.measure.store import EpisodeResult, Store
from madviz.measure.table import Table
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_condition
from madviz.policies import checkpoint
from madviz.policies.guarded import with_guard
from madviz.policies.seeds import seeds_from
from madviz.subsets import cameras_of
from madviz.system.files import write_json
from madviz.system.numbers import ThreadsOrNone

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
    noticed: list[int | None]
    """By episode with the guard: how many steps after the failure began it noticed something, 0 at
    the same one; None: at none, or before it began, which is a false alarm. In intact episodes
    these are false alarms, from the first step."""


@dataclass(frozen=True)
class GuardTrialConfig(GuardAlarmsConfig):
    """The policies, which have fitted guards, and the episodes of each condition."""

    ways: tuple[str, ...] = WAYS
    """How each camera fails, and from which step on if not the first: ``freeze@20``; no word after
    it: intact episodes alone."""
    cameras: tuple[str, ...] = ()
    """The cameras that fail, one at a time; by default every one."""
    workers: ThreadsOrNone | None = None
    """Processes; by default one per core. 0 runs everything in this one."""


class GuardTrialFile(TypedDict):
    """The whole result."""

    schema: int
    seeds: list[int]
    rows: list[TrialRow]


def guard_trial(config: GuardTrialConfig) -> GuardTrialFile:
    """Plays what is missing. Raises UserError for a policy without fitted values."""
    seeds = seeds_from(config.seed, config.episodes)
    config.out.mkdir(parents=True, exist_ok=True)
    result: GuardTrialFile = {"schema": 1, "seeds": list(seeds), "rows": []}
    with closing(Store(config.out / "episodes.sqlite")) as store:
        for name in config.policies:
            result["rows"] += _of_policy(name, seeds, store, config)
            write_json(config.out / "trial.json", result)
            note_trial(name, seeds)
    return result


def trial_words(result: GuardTrialFile) -> str:
    """The result as lines."""
    lines = []
    for row in result["rows"]:
        place = f"{row['camera']} {row['way']}" if row["camera"] else "intact"
        rates = [f"{word} {row[word]:.2f}" for word in ("broken", "guarded", "dropped")]
        noticed = noticed_words(row["noticed"]) if row["camera"] else alarms_words(row["noticed"])
        lines.append(f"{row['policy']:40} {place:24} {' '.join(rates)} n={row['n']}; {noticed}")
    return "\n".join(lines)


def steps_after(begin: int, alarms: Iterable[int | None]) -> list[int | None]:
    """Steps from ``begin`` until the first alarm of each episode; None where none was raised, or
    one before: that one was false, and the store doesn't hold a second."""
    return [None if at is None or at < begin else at - begin for at in alarms]


def note_trial(name: str, seeds: range) -> None:
    """Adds an included policy to the ledger of readings, where these are reporting seeds. A trial
    that goes on, or adds conditions, is the same reading."""
    policy = checkpoint.describe(name)
    facts = (policy.spec.name, policy.spec.task, policy.spec.digest)
    rows = readings(policy.path)
    if not any((*facts, seeds[0], seeds[-1]) == row[1:] for row in rows):
        note_reading(policy.path, *facts, seeds)


def _of_policy(
    name: str, seeds: range, store: Store, config: GuardTrialConfig
) -> Iterator[TrialRow]:
    bare, policy = Table.opened(name, store, own=True)
    guarded, _ = Table.opened(with_guard(name, True), store, own=True)
    streams = policy.spec.streams
    cameras = cameras_of(streams)

    def play(table: Table, conditions: Iterable[Condition], which: Iterable[int]) -> None:
        """All at once: processes start and simulators are made once."""
        jobs = [(condition, seed) for condition in dict.fromkeys(conditions) for seed in which]
        table.play(jobs, config.workers, progress=True)

    def played(table: Table, condition: Condition) -> dict[int, EpisodeResult]:
        results = table.results(condition)
        return {seed: results[seed] for seed in seeds if seed in results}

    def row(camera: str, way: str, *results: dict[int, EpisodeResult], begin: int = 0) -> TrialRow:
        broken, with_it, dropped = (
            SuccessRate.counted(result.success for result in each.values()).value
            for each in results
        )
        return TrialRow(
            policy=name,
            camera=camera,
            way=way,
            broken=broken,
            guarded=with_it,
            dropped=dropped,
            n=len(seeds),
            noticed=steps_after(begin, (result.noticed for result in results[1].values())),
        )

    failing = {
        (camera, way): parse_condition(f"{camera}={way}", cameras).noticed(streams)
        for camera in config.cameras or cameras
        for way in config.ways
    }
    without = {
        (camera, fails.begin): Condition(
            "+".join(one for one in cameras if one != camera) or "none", begin=fails.begin
        ).noticed(streams)
        for (camera, _), fails in failing.items()
    }
    intact = Condition("all").noticed(streams)
    play(guarded, [intact, *failing.values()], seeds)
    play(bare, [*failing.values(), *without.values()], seeds)
    watched = played(guarded, intact)
    play(bare, [intact], [seed for seed, one in watched.items() if one.noticed is not None])
    unwatched = watched | played(bare, intact)
    yield row("", "", unwatched, watched, unwatched)
    for (camera, way), fails in failing.items():
        dropped = played(bare, without[camera, fails.begin])
        both = (played(bare, fails), played(guarded, fails))
        yield row(camera, way, *both, dropped, begin=fails.begin)
