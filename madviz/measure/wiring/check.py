"""``madviz wiring --policy ws://HOST:PORT --wire FILE``: is a served policy wired right?

    As wired: 0 of 6. With third_a and third_b swapped: 6 of 6. Try this in your wire file:
    cameras = { ... }

What people get wrong is tried one at a time: a change of the file goes on to episodes where the
policy then acts clearly more like the scripted expert (``screen.py``), and is advised where
episodes confirm it (``confirm.py``). The file is never changed.
"""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypedDict

from madviz.errors import UserError
from madviz.measure.episodes import FIRST_SEED, Job, Runner
from madviz.measure.wiring.candidates import candidates
from madviz.measure.wiring.confirm import ENOUGH, Played, compared
from madviz.measure.wiring.screen import (
    LOOKS,
    SCENES,
    Screened,
    Screening,
    expert_looks,
    going_on,
    screened,
)
from madviz.observation.condition import Condition
from madviz.policies import checkpoint
from madviz.system.numbers import Seed
from madviz.wire.policy import ServedPolicy
from madviz.wire.reference import rewired, with_wire
from madviz.wire.wiring import Wiring


@dataclass(frozen=True)
class WiringConfig:
    """Tries what people get wrong in a wire file, and says in words what helps."""

    policy: checkpoint.PolicyName
    """ws://HOST:PORT of a policy that is served."""
    wire: Path | None = None
    """How its names and shapes map to ours, a TOML file."""
    seed: Seed = FIRST_SEED
    """The first scene; six are looked at, and ten at most are played."""
    json: str | None = None
    """Where to write the result; - is standard output."""


class ChangeRow(TypedDict):
    """A change that was tried."""

    kind: str
    label: str
    lines: str
    distance: float | None
    """From the expert's actions; None where the server refused."""
    refused: str
    successes: int
    """Successes of ``n`` episodes; fewer or none where they were not needed."""
    before: int
    """Successes of the file as it is, on the same scenes."""
    n: int
    verdict: str


class WiringFile(TypedDict):
    """The document of ``madviz wiring --json``."""

    schema: int
    policy: str
    task: str
    seed: int
    sentence: str
    verdict: str
    """``helps``, ``as wired is best``, ``nothing does better`` or ``cannot tell``."""
    distance: float
    """From the expert's actions, as wired."""
    successes: int
    """As wired, of ``n`` episodes."""
    n: int
    changes: list[ChangeRow]
    """Those that went on to episodes first."""


def wiring(policy: ServedPolicy, seed: int = FIRST_SEED, progress: bool = False) -> WiringFile:
    """Tries changes of how ``policy`` is wired on the scenes from ``seed`` on. Raises UserError
    where its server refuses it as it is wired."""
    as_wired = rewired(policy, policy.wiring)
    with closing(Runner()) as runner:
        env, _ = runner.opened(_job(runner, as_wired, seed))
        tried = candidates(policy.wiring, env.spec)
        sizes = {policy.wiring.largest, *(c.wiring.largest for c in tried)}
        screen = Screening(as_wired, expert_looks(env, as_wired.spec, sizes, seed))
        distance = screen.distance(policy.wiring, SCENES * len(LOOKS))
        results = screened(screen, tried)
        chosen = going_on(results, distance)
        if progress:
            labels = [result.candidate.label for result in chosen]
            said = f"closer to the expert: {'; '.join(labels) or 'none'}"
            print(f"{len(tried)} changes tried; {said}", file=sys.stderr)

        def played(wiring: Wiring) -> Played:
            changed = rewired(policy, wiring)

            @cache
            def succeeded(scene: int) -> bool:
                job = _job(runner, changed, seed + SCENES + scene)  # No scene that was looked at.
                return runner.run(job)[0].success

            return succeeded

        before = played(policy.wiring)
        rows: list[ChangeRow] = []
        for result in [*chosen, *(result for result in results if result not in chosen)]:
            row = _row(result)
            helped = any(each["verdict"] == "helps" for each in rows)
            if result in chosen and not helped:
                found = compared(before, played(result.candidate.wiring))
                row["successes"] = found.successes
                row["before"] = found.before
                row["n"] = found.n
                row["verdict"] = found.verdict
            rows.append(row)
        outcomes = [before(scene) for scene in range(max([ENOUGH, *(row["n"] for row in rows)]))]
    document: WiringFile = {
        "schema": 1,
        "policy": policy.spec.name,
        "task": policy.spec.task,
        "seed": seed,
        "sentence": "",
        "verdict": _verdict(rows, any(outcomes)),
        "distance": distance,
        "successes": sum(outcomes),
        "n": len(outcomes),
        "changes": rows,
    }
    document["sentence"] = _sentence(document)
    return document


def _job(runner: Runner, policy: ServedPolicy, seed: int) -> Job:
    runner.adopt("", policy)
    return Job("", policy.spec.digest, Condition("all"), seed)


def _row(result: Screened) -> ChangeRow:
    return {
        "kind": result.candidate.kind,
        "label": result.candidate.label,
        "lines": result.candidate.lines,
        "distance": None if result.refused else result.distance,
        "refused": result.refused,
        "successes": 0,
        "before": 0,
        "n": 0,
        "verdict": "",
    }


def _verdict(rows: list[ChangeRow], any_success: bool) -> str:
    found = {row["verdict"] for row in rows}
    for verdict in ("helps", "cannot tell"):
        if verdict in found:
            return verdict
    return "as wired is best" if any_success else "nothing does better"


def _sentence(document: WiringFile) -> str:
    """The result in words."""
    wired = f"As wired: {document['successes']} of {document['n']}."
    verdict = document["verdict"]
    if verdict == "as wired is best":
        return (
            f"{wired} Of {len(document['changes'])} changes that were tried, none is better: as "
            "wired is best, or as good."
        )
    if verdict == "nothing does better":
        return (
            f"{wired} Nothing that was tried does better, of {len(document['changes'])} changes, "
            "one at a time."
        )
    row = next(row for row in document["changes"] if row["verdict"] == verdict)
    rates = f"{row['before']} of {row['n']}. With {row['label']}: {row['successes']} of {row['n']}"
    if verdict == "helps":
        return f"As wired: {rates}. Try this in your wire file:\n{row['lines']}"
    return (
        f"As wired: {rates}. Cannot tell: the policy acts more like the expert with the change, "
        "and so few episodes do not say whether it helps."
    )


# --- The command ----------------------------------------------------------------------------


def run_wiring(config: WiringConfig) -> WiringFile:
    """``madviz wiring``; progress goes to standard error. Raises UserError for a policy that is not
    served."""
    policy = checkpoint.load_policy(with_wire(config.policy, config.wire))
    if not isinstance(policy, ServedPolicy):
        raise UserError(
            f"--policy: expected ws://HOST:PORT of a policy that is served, found "
            f"{config.policy!s:.100}, which needs no wire file; see madviz serve"
        )
    return wiring(policy, config.seed, progress=True)


def wiring_words(document: WiringFile) -> str:
    """The result as lines."""
    refused = sum(bool(row["refused"]) for row in document["changes"])
    note = f"The server refused {refused} of the changes.\n" if refused else ""
    return f"{document['policy']} on {document['task']}\n{note}{document['sentence']}"
