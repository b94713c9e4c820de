"""Visitors come, touch controls and go, for an hour; the page's server must not grow.

A server in a process of its own, visitors without browsers (``visitor.py``), rounds of 20 s
(``--round-seconds``: more where a simulation takes long to open). In a round visitors come and go
and touch controls at random, by a seed; one more of them may come than there are simulations, so
some watch and take over. After each round everybody leaves, and what is still there is written
down: memory and threads of the server and its children, and how many processes that is.

    round   1    2    3  │  4    5    6    7    8    9   10   11
            warm-up      │  first ─                     last ───   of 11 rounds a third is warm-up
            665  680  672│ 674  678  676  678  676  678  678  680  MB: 678.8 after 675.8, 0.4 %

The first rounds fill what stays for good: the allocator's pools, caches of glyphs, viser's threads
for callbacks. The bounds: the median of the last third of what follows is at most 2 % above the
first third's, no more threads (but for ``POOL``) or processes than before, nothing in the log. And
visitors must have got pictures, one each at least: where a machine is so busy that they leave
before the first one, nothing was tried.
"""

from __future__ import annotations

import math
import random
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from benchmarks.memory import kilobytes
from benchmarks.page_server import serving
from benchmarks.visitor import Visitor
from madviz.errors import UserError
from madviz.policies.checkpoint import PolicyName
from madviz.system.numbers import Count, Range, Seed, ThreadsOrNone
from madviz.system.processes import family

FEWEST = 9
"""Rounds; where the time is too short for them, they are shorter."""
MOST_GROWTH = 0.02
POOL = 4
"""Threads that viser's pool for callbacks may have started late: it grows to its busiest moment."""
IMPATIENT = 0.2
"""Share of those who leave although they have not seen a picture yet."""
SETTLING = 20.0
"""Seconds that visitors who left may take to disappear; longer rounds allow as long as themselves,
because a simulation that is being opened ends only when it is open."""


@dataclass(frozen=True)
class SoakConfig:
    """Lets visitors come and go, and says whether the server has grown."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    minutes: Annotated[float, Range(float, 0, 10_000, above=True)] = 60.0
    """How long; 3 are enough to see a leak of whole pages."""
    visitors: Count = 3
    """How many are there at most; all but one of them get a simulation."""
    policy: PolicyName = "metaworld-hammer-mad-light"
    """A name of a policy, its folder, or module:factory."""
    workers: ThreadsOrNone = 0
    """Processes that measure success in the background."""
    seed: Seed = 0
    """The seed of the visitors' random actions."""
    round_seconds: Annotated[float, Range(float, 0, 3600, above=True)] = 20.0
    """After so long everybody leaves and what is left is counted. Take several times as long as the
    first picture takes: who leaves before it has tried nothing."""


class Sample(NamedTuple):
    """Memory and threads of the server while nobody visits it."""

    memory_mb: float
    threads: int
    processes: int


class Crowd:
    """Visitors of one page, who come, touch controls and go at random."""

    def __init__(self, url: str, pid: int, most: int, seed: int) -> None:
        self._url = url
        self._pid = pid
        self._most = most
        self._rng = random.Random(seed)
        self._calm: int | None = None
        """Threads that were left after the last round."""
        self.visits = 0
        self.touches = 0
        self.updates = 0

    def round(self, seconds: float) -> Sample:
        """Some coming, going and touching; then everybody leaves, and what is left is counted."""
        here: list[Visitor] = []
        end = time.monotonic() + seconds
        try:
            while time.monotonic() < end:
                self._act(here)
                time.sleep(self._rng.uniform(0.02, 0.3))
        finally:
            for visitor in here:
                self._leave(visitor)
        left = settled(self._pid, self._calm, max(SETTLING, seconds))
        self._calm = left.threads
        return left

    def _act(self, here: list[Visitor]) -> None:
        chance = self._rng.random()
        if not here or (chance < 0.12 and len(here) < self._most):
            here.append(Visitor(self._url))
            self.visits += 1
        elif chance < 0.18:
            number = self._rng.randrange(len(here))
            if here[number].steps or self._rng.random() < IMPATIENT:
                self._leave(here.pop(number))
        else:
            self.touches += self._rng.choice(here).toggle(self._rng)

    def _leave(self, visitor: Visitor) -> None:
        self.updates += len(visitor.steps)
        visitor.close()


def soak(config: SoakConfig) -> dict[str, Any]:
    """Runs server and visitors; see the module. Raises UserError for a machine without /proc, and
    for a server that ends before ``FEWEST`` rounds."""
    words = ["--policy", config.policy, "--workers", str(config.workers)]
    words += ["--visitors", str(max(1, config.visitors - 1))]
    with tempfile.TemporaryFile("w+") as log, serving(words, log) as (url, process):
        crowd = Crowd(url, process.pid, config.visitors, config.seed)
        samples: list[Sample] = []
        trouble = ""
        begun = time.monotonic()
        try:
            for one in rounds(crowd, 60 * config.minutes, config.round_seconds):
                samples.append(one)
        except UserError as error:  # Nothing answers any more.
            trouble = str(error)
        minutes = (time.monotonic() - begun) / 60  # Fewer than asked, where the server died.
        died = process.poll() is not None
        log.seek(0)
        errors = [line.rstrip() for line in log if line.strip()]
    errors += [trouble] if trouble else []
    errors += ["the server ended by itself"] if died else []
    if len(samples) < FEWEST:
        raise UserError(
            "\n".join([f"expected {FEWEST} rounds, found {len(samples)}", *errors[-10:]])
        )
    verdict = judged(samples, minutes)
    served = crowd.updates >= crowd.visits
    return {
        "schema": 1,
        "policy": config.policy,
        "workers": config.workers,
        "minutes": minutes,
        "seed": config.seed,
        "round_seconds": config.round_seconds,
        "visits": crowd.visits,
        "touches": crowd.touches,
        "updates": crowd.updates,
        **verdict,
        "served": served,
        "log_lines": len(errors),
        "errors": errors[:50],
        "ok": verdict["kept"] and served and not errors,
    }


def rounds(crowd: Crowd, seconds: float, longest: float) -> Iterator[Sample]:
    """Rounds until the time is over, ``FEWEST`` at least."""
    length = min(longest, seconds / FEWEST)
    end = time.monotonic() + seconds
    done = 0
    while done < FEWEST or time.monotonic() < end:
        yield crowd.round(length)
        done += 1


def warm_up(rounds: int) -> int:
    """Rounds that are not judged: a third, or a tenth where there are 30 and more."""
    return rounds // (3 if rounds < 30 else 10)


def judged(samples: Sequence[Sample], minutes: float) -> dict[str, Any]:
    """After the warm-up the last third is compared with the first. ``kept``: no bound is
    exceeded."""
    ignored = warm_up(len(samples))
    warm = samples[ignored:]
    part = max(1, len(warm) // 3)
    first = warm[:part]
    last = warm[-part:]
    before = statistics.median(s.memory_mb for s in first)
    after = statistics.median(s.memory_mb for s in last)
    growth = after / before - 1
    between = minutes / 60 * (len(warm) - part) / len(samples)  # Hours, from middle to middle.
    threads = (int(max(s.threads for s in first)), int(min(s.threads for s in last)))
    processes = (max(s.processes for s in first), min(s.processes for s in last))
    within = (
        growth <= MOST_GROWTH and threads[1] <= threads[0] + POOL and processes[1] <= processes[0]
    )
    return {
        "rounds": len(samples),
        "warm_up": ignored,
        "memory_mb": {
            "after_warm_up": round(before, 1),
            "end": round(after, 1),
            "growth": round(growth, 4),
            "growth_an_hour": round((after - before) / between, 1),
            "rounds": [round(s.memory_mb, 1) for s in samples],
        },
        "threads": {
            "after_warm_up": threads[0],
            "end": threads[1],
            "rounds": [s.threads for s in samples],
        },
        "processes": {"after_warm_up": processes[0], "end": processes[1]},
        "kept": within,
    }


def settled(pid: int, calm: int | None = None, longest: float = SETTLING) -> Sample:
    """A sample of ``pid`` and its children once their threads have been the same for 1 s, and no
    more than ``calm`` if that is known: on a busy machine a simulator that is being opened takes
    seconds before it notices that nobody needs it any more. Waits ``longest`` seconds at most."""
    seen = sample(pid)
    since = time.monotonic()
    deadline = since + longest
    most = math.inf if calm is None else calm
    while time.monotonic() < deadline:
        if time.monotonic() - since >= 1.0 and seen.threads <= most:
            break
        time.sleep(0.1)
        now = sample(pid)
        if (now.threads, now.processes) != (seen.threads, seen.processes):
            since = time.monotonic()
        seen = now
    return seen


def sample(pid: int) -> Sample:
    """Memory, threads and number of ``pid`` and all its children. Raises UserError where the system
    does not tell."""
    if kilobytes("VmRSS") is None:
        raise UserError("expected Linux for a soak, found no /proc/self/status; run it there")
    memory = 0
    threads = 0
    processes = family(pid)
    for one in processes:
        try:
            occupied = kilobytes("VmRSS", Path(f"/proc/{one}/status"))
            threads += len(list(Path(f"/proc/{one}/task").iterdir()))
        except OSError:  # It ended meanwhile.
            continue
        memory += occupied or 0
    return Sample(memory / 1024, threads, len(processes))


def soak_words(result: dict[str, Any]) -> str:
    """The result in a few lines."""
    memory = result["memory_mb"]
    threads = result["threads"]
    lines = [
        f"{result['visits']} visits, {result['touches']} touches, {result['updates']} updates in "
        f"{result['minutes']:.1f} min",
        f"memory {memory['after_warm_up']} -> {memory['end']} MB ({100 * memory['growth']:+.1f} %, "
        f"{memory['growth_an_hour']:+.1f} MB an hour)",
        f"threads {threads['after_warm_up']} -> {threads['end']}, processes "
        f"{result['processes']['after_warm_up']} -> {result['processes']['end']}",
        f"lines in the log: {result['log_lines']}",
        *result["errors"][:10],
        "the server has not grown" if result["kept"] else "THE SERVER HAS GROWN, see above",
    ]
    if not result["served"]:
        lines.append(
            f"TOO FEW PICTURES FOR A SOAK: {result['updates']} pictures came in {result['visits']} "
            "visits; run it with nothing else running, or with longer rounds (--round-seconds)"
        )
    return "\n".join(lines)
