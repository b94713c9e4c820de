"""The table of docs/guard.md: success with a guard and without on each of the twenty tasks, and
false alarms, from results/guard (``python -m benchmarks guard-trial``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from measurements import read, table
from policy_files import LABELS

from madviz.measure.statistics import SuccessRate, interval_over_trainings
from madviz.policies import checkpoint
from madviz.policies.seeds import use_of

SIDES = ("broken", "guarded", "dropped")
NAMES = {"black": "black", "freeze": "frozen"}
"""The ways of the first table, in which First person fails."""
ALL_NAMES = {
    **NAMES,
    "freeze@20": "frozen from step 20",
    "dropout:0.5": "lossy",
    "noise": "noise",
    "delay:0.5": "late by 5",
}
FIRST = "first"
CAMERAS = (FIRST, "third_a", "third_b")
ALARMS = "guard/alarms"
UNBROKEN = {
    "intact": "Intact",
    "stood": "The robot stands for 15 decisions",
    "moved": "One camera is moved by 8 cm and turned by 5 degrees",
}
"""By the key of ``benchmarks guard-alarms``."""
INTACT = "guard/intact"
BROKEN = "guard/broken"


def guard_trial() -> str:
    """Success broken, guarded and dropped with First person, for each task, and one row for all."""
    rows = [row for row in read(BROKEN)["rows"] if row["camera"] == FIRST]
    ways = [way for way in NAMES if any(row["way"] == way for row in rows)]
    alarms = {row["policy"]: _alarms(row) for row in read(INTACT)["rows"]}
    header = ["task", "false alarms", *(f"{NAMES[way]}: {side}" for way in ways for side in SIDES)]
    lines = []
    for policy in alarms:
        ours = [row for row in rows if row["policy"] == policy]
        measured = [_rate(ours, way, side) for way in ways for side in SIDES]
        cells = [f"{rate.value:.2f}" if rate.n else "–" for rate in measured]
        task = checkpoint.describe(policy).config.task
        lines.append([task, f"{alarms[policy][0]} of {alarms[policy][1]}", *cells])
    found, n = (sum(column) for column in zip(*alarms.values(), strict=True))
    cells = [_over_tasks(rows, way, side) for way in ways for side in SIDES]
    lines.append(["all", f"{found} of {n}", *cells])
    return f"{table(header, lines)}\n{_sentences(rows, ways, found, n)}\n"


def guard_ways() -> str:
    """A row for each camera and way: success over all tasks, and when it was noticed."""
    rows = read(BROKEN)["rows"]
    lines = []
    apart = 0.0
    for camera in CAMERAS:
        for way, name in ALL_NAMES.items():
            ours = [row for row in rows if (row["camera"], row["way"]) == (camera, way)]
            rates = [_over_tasks(ours, way, side) for side in SIDES]
            guarded, dropped = (_rate(ours, way, side).value for side in SIDES[1:])
            apart = max(apart, abs(guarded - dropped))
            steps = [step + 1 for row in ours for step in row["noticed"] if step is not None]
            every = sum(len(row["noticed"]) for row in ours)
            when = f"{np.median(steps):g}; {np.percentile(steps, 95):g}" if steps else "–"
            lines.append([LABELS[camera], name, *rates, f"{len(steps)} of {every}", when])
    header = ["camera", "fails", *SIDES, "noticed in", "at step: median; 95 %"]
    points = round(100 * apart)
    cells = [row for row in rows if row["camera"]]
    fewer = [row for row in cells if row["guarded"] < row["dropped"]]
    more = sum(row["guarded"] > row["dropped"] for row in cells)
    named = "; ".join(
        f"{checkpoint.describe(row['policy']).config.task} with {LABELS[row['camera']]} "
        f"{ALL_NAMES[row['way']]}"
        for row in fewer
    )
    said = (
        f"In every row success with the guard is within {points} point{'s' * (points != 1)} of "
        f"success with the camera dropped. A row is {len(cells) // len(lines)} tasks with "
        f"{cells[0]['n']} episodes each. In {len(fewer)} of all {len(cells)} such groups fewer "
        f"episodes succeeded with the guard ({named}), in {more or 'none'} more."
    )
    return f"{table(header, lines)}\n{said}\n"


def guard_alarms() -> str:
    """Sentences on alarms where no camera fails: intact, with a robot that stands, with a camera
    that is moved."""
    results = read(ALARMS)
    said = []
    for key, what in UNBROKEN.items():
        alarms = [alarm.split() for result in results for alarm in result[key]]
        episodes = sum(len({alarm[0] for alarm in map(str.split, one[key])}) for one in results)
        n = sum(len(one["seeds"]) for one in results)
        kinds = Counter(alarm[2].split("@")[0] for alarm in alarms)
        named = ", ".join(f"{kind} {count}" for kind, count in kinds.most_common())
        first = sum(alarm[1] == FIRST for alarm in alarms)
        low, high = SuccessRate.of(episodes, n).interval
        words = f" ({named}; {first} of {len(alarms)} in First person)" if alarms else ""
        said.append(
            f"- {what}: an alarm in {episodes} of {n} episodes{words}, {100 * low:.0f} to "
            f"{100 * high:.0f} in 100 (95 %)."
        )
    seeds = results[0]["seeds"]
    said.append(
        f"- {len(seeds)} episodes of each of {len(results)} tasks, {use_of(seeds)} seeds "
        f"{seeds[0]} to {seeds[-1]}."
    )
    return "\n".join(said) + "\n"


def headline() -> str:
    """One finding for the front page: a frozen camera, with the guard and without."""
    rows = [row for row in read(BROKEN)["rows"] if row["camera"] == FIRST]
    broken, guarded = (_over_tasks(rows, "freeze", side) for side in ("broken", "guarded"))
    ours = [row for row in rows if row["way"] == "freeze"]
    use = use_of(read(BROKEN)["seeds"])
    return (
        "Not of the paper: a broken camera is not an absent one. With First person frozen, MAD's "
        f"success is {broken}. With the [guard](docs/guard.md), which leaves such a camera out, it "
        f"is {guarded} (interval over {len(ours)} tasks, {ours[0]['n']} episodes of each, "
        f"{use} seeds)."
    )


def _sentences(rows: list[dict[str, Any]], ways: list[str], found: int, n: int) -> str:
    low, high = (100 * end for end in SuccessRate.of(found, n).interval)
    said = [
        f"{found} false alarm{'' if found == 1 else 's'} in {n:,} intact episodes: {low:.1f} to "
        f"{high:.1f} in 100 (95 %)."
    ]
    for way in ways:
        ours = [row for row in rows if row["way"] == way]
        steps = [step for row in ours for step in row["noticed"] if step is not None]
        seen, every = len(steps), sum(len(row["noticed"]) for row in ours)
        broken, guarded, dropped = (_over_tasks(rows, way, side) for side in SIDES)
        said.append(
            f"A {NAMES[way]} camera: {broken} without the guard, {guarded} with it, {dropped} with "
            f"the camera dropped; noticed in {seen} of {every} episodes, at step "
            f"{np.median(steps) + 1:g} (median), at the latest at step {max(steps) + 1}."
        )
    said += [_seeds_words(INTACT, "intact episodes"), _seeds_words(BROKEN, "with each failure")]
    return "\n".join(f"- {sentence}" for sentence in said)


def _seeds_words(file: str, what: str) -> str:
    seeds = read(file)["seeds"]
    return f"{len(seeds)} {what} of each task, {use_of(seeds)} seeds {seeds[0]} to {seeds[-1]}."


def _over_tasks(rows: Iterable[dict[str, Any]], way: str, side: str) -> str:
    """The mean over tasks. Its interval is Student's t over them, at least as wide as the one over
    episodes."""
    kept = list(rows)
    tasks = [[row[side]] * row["n"] for row in kept if row["way"] == way]
    rate = _rate(kept, way, side)
    return replace(rate, interval=interval_over_trainings([tasks], rate.interval)).without_count


def _alarms(row: dict[str, Any]) -> tuple[int, int]:
    """Intact episodes in which the guard noticed something, and all of them."""
    return sum(step is not None for step in row["noticed"]), len(row["noticed"])


def _rate(rows: Iterable[dict[str, Any]], way: str, side: str) -> SuccessRate:
    """Success over all ``rows`` of one way."""
    ours = [row for row in rows if row["way"] == way]
    successes = sum(round(row[side] * row["n"]) for row in ours)
    return SuccessRate.of(successes, sum(row["n"] for row in ours))
