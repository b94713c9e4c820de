"""``madviz sweep FILE``: many trainings and their evaluations, from one small file.

    madviz sweep settings.toml --dry-run       what it would do (the file: see sweep_plan.py)
    madviz sweep settings.toml                 here, a process for each run
    madviz sweep settings.toml --backend ray   on a cluster; every node must see the same --out

A sweep has no memory but its folders (run.py). Kill it at any moment and give the same
command again: finished runs are left alone, a training that was cut off resumes. Two sweeps may
even work on one folder at a time. A run that fails does not stop the others; it is listed at the
end, and tried again by the next call.

    plan -> waiting -> backend.submit(run) -> backend.collect() -> finished, failed, waiting again

Backends differ only in where ``carry_out`` is called, so results are the same files.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from madviz.policies.measured import RateRow
from madviz.runs.curve import duration
from madviz.sweep.run import (
    Run,
    RunOutcome,
    broken,
    carry_out,
    check_same,
    expected_seconds,
    finished,
    result_rows,
)
from madviz.sweep.sweep_plan import read_plan
from madviz.system.machine import cores
from madviz.system.numbers import Threads, check_numbers
from madviz.system.signals import terminable
from madviz.system.streams import say

if TYPE_CHECKING:
    from madviz.sweep.ray import RayBackend

BUSY_SECONDS = 2.0
"""How long a run that another process works on is left alone."""

QUIET_SECONDS = 60.0
"""Where no bar can be drawn, a line is printed after as long a silence."""


@dataclass(frozen=True)
class SweepConfig:
    """Trains and evaluates every combination that a small TOML file asks for."""

    file: str
    """The sweep file: a table [grid] with tasks, methods, settings, seeds, and a table [eval]."""
    out: Path | None = None
    """Where the runs' folders go; runs/NAME-OF-FILE if not given. The same folder goes on."""
    backend: Literal["local", "ray"] = "local"
    """``local``: processes on this machine. ``ray``: a Ray cluster that shares ``out``."""
    jobs: Threads | None = None
    """Runs at a time; by default one for every two cores here, and what fits on a cluster."""
    address: str | None = None
    """The address of the Ray cluster; by default $RAY_ADDRESS, or a new one on this machine."""
    cpus: Threads = 2
    """Cores that a run takes on a Ray cluster."""
    dry_run: bool = False
    """Only say which runs there are and which are finished."""
    json: str | None = None
    """Where to write the outcome of every run; - is standard output."""


class LocalBackend:
    """Threads of this process that each watch one command."""

    def __init__(self, out: Path, jobs: int, program: Sequence[str] = ()) -> None:
        self.slots = jobs
        """How many runs it takes at a time, now."""
        self._out = out
        self._program = program
        self._stop = threading.Event()
        self._workers = max(cores() // jobs, 1)
        self._pool = ThreadPoolExecutor(jobs)
        self._running: dict[Future[RunOutcome], Run] = {}

    def submit(self, run: Run) -> None:
        """Begins a run; call it only while there is a free slot."""
        future = self._pool.submit(
            carry_out, run, self._out, self._program, self._workers, self._stop
        )
        self._running[future] = run

    def collect(self, seconds: float) -> list[tuple[Run, RunOutcome]]:
        """The runs that ended since the last call; waits up to ``seconds`` for something."""
        done, _ = wait(self._running, seconds, FIRST_COMPLETED)
        return [(self._running.pop(future), future.result()) for future in done]

    def close(self) -> None:
        """Ends what still runs, with SIGTERM, and waits for it."""
        self._stop.set()
        self._pool.shutdown(wait=True, cancel_futures=True)


def run_sweep(config: SweepConfig, program: Sequence[str] = ()) -> SweepResult:
    """``madviz sweep``: the outcome of every run; progress goes to standard error.

    ``program`` stands for ``madviz`` in every run. Raises UserError before anything runs for a
    mistake in the file, and for folders that hold runs of another file.
    """
    check_numbers(config)
    runs = read_plan(config.file)
    out = config.out or Path("runs") / Path(config.file).stem
    for run in runs:
        if not broken(out / run.name):
            check_same(out / run.name, run)
    if config.dry_run:
        return _summary(runs, out, config, {})
    out.mkdir(parents=True, exist_ok=True)
    left = [run for run in runs if not finished(out / run.name)]
    if not left:
        return _summary(runs, out, config, {})
    engine = _backend(config, out, program)
    watch = Watch(len(runs), len(left), lambda run: expected_seconds(out / run.name))
    try:
        with watch, terminable():
            outcomes = carry_all_out(left, engine, watch)
    except KeyboardInterrupt:
        watch.say("stopping: trainings save first; the same command goes on from there")
        raise
    finally:
        engine.close()
    return _summary(runs, out, config, outcomes)


def _backend(config: SweepConfig, out: Path, program: Sequence[str]) -> LocalBackend | RayBackend:
    if config.backend == "ray":
        from madviz.sweep.ray import RayBackend

        return RayBackend(out, config.jobs, config.address, config.cpus, program)
    return LocalBackend(out, config.jobs or max(cores() // 2, 1), program)


def carry_all_out(
    runs: Sequence[Run],
    backend: LocalBackend | RayBackend,
    watch: Watch,
    now: Callable[[], float] = time.monotonic,
) -> dict[str, RunOutcome]:
    """Every run's last outcome, by name. A busy run goes to the end of the queue."""
    waiting = deque(runs)
    running = 0
    outcomes = dict[str, RunOutcome]()
    earliest: dict[str, float] = {}
    while waiting or running:
        for _ in range(len(waiting)):
            if running >= backend.slots:
                break
            run = waiting.popleft()
            if earliest.get(run.name, 0.0) > now():
                waiting.append(run)
                continue
            backend.submit(run)
            watch.began(run)
            running += 1
        if not running:
            time.sleep(0.2)
            continue
        for run, outcome in backend.collect(1.0):
            running -= 1
            if outcome.state == "busy":
                earliest[run.name] = now() + BUSY_SECONDS
                waiting.append(run)
            else:
                outcomes[run.name] = outcome
            watch.ended(run, outcome)
        watch.tick(backend.slots)
    return outcomes


class Watch:
    """Progress and time left for the whole, on standard error.

    Time left: 24 runs of 600 s that have not begun, 4 at a time, are 24 / 4 x 600 s = 1 h; a run
    that has begun counts for what the mean leaves of it. The mean is over runs that have ended, and
    those whose training says how long it will take (``expects``); without any, nothing is said.
    """

    def __init__(
        self,
        total: int,
        left: int,
        expects: Callable[[Run], float | None] = lambda run: None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._now = now
        self._expects = expects
        self._slots = 1
        self._last_line = now()
        self._total = total
        self._left = left
        self._failed = 0
        self._begun: dict[Run, float] = {}
        self._seconds: list[float] = []
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("sweep"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, completed=total - left, state="")

    def __enter__(self) -> Watch:
        self.say(f"{self._total} runs, {self._total - self._left} finished before")
        self._bar.start()
        return self

    def __exit__(self, *reason: object) -> None:
        self._bar.stop()

    def began(self, run: Run) -> None:
        """Takes note of a run that was submitted."""
        self._begun[run] = self._now()

    def ended(self, run: Run, outcome: RunOutcome) -> None:
        """Takes note of how a run came out, and prints a line."""
        del self._begun[run]
        if outcome.state in ("busy", "stopped"):
            return
        self._left -= 1
        how = f"finished in {duration(outcome.seconds)}"
        if outcome.state != "finished":
            self._failed += 1
        elif outcome.seconds:
            self._seconds.append(outcome.seconds)
        else:
            how = "was finished by another sweep"
        if outcome.state == "failed":
            how = f"failed: {outcome.error}"
        self.say(f"{self._total - self._left} of {self._total}: {run.name} {how}{self._rest()}")

    def tick(self, slots: int) -> None:
        """Draws; ``slots`` is how many runs go at a time."""
        self._slots = slots
        failed = f"{self._failed} failed, " if self._failed else ""
        state = f"{failed}{len(self._begun)} running{self._rest()}"
        self._bar.update(self._task, completed=self._total - self._left, state=state)
        if self._bar.disable and self._now() - self._last_line > QUIET_SECONDS:
            self.say(state)

    def seconds_left(self) -> float | None:
        """None before it can be estimated."""
        expected = [seconds for run in self._begun if (seconds := self._expects(run)) is not None]
        known = [*self._seconds, *expected]
        if not known:
            return None
        mean = sum(known) / len(known)
        running = [max(mean - (self._now() - began), 0.0) for began in self._begun.values()]
        waiting = (self._left - len(running)) * mean
        return max((waiting + sum(running)) / self._slots, max(running, default=0.0))

    def _rest(self) -> str:
        left = self.seconds_left()
        return f"; {duration(left)} left" if left and self._left else ""

    def say(self, line: str) -> None:
        """Prints a line on standard error."""
        self._last_line = self._now()
        # Through the bar where there is one, so that their lines do not mix.
        if self._bar.disable:
            say(f"[sweep] {line}")
        else:
            self._bar.console.print(line, markup=False, highlight=False)


class RunRow(TypedDict):
    """A run, as documents hold it."""

    name: str
    path: str
    train: list[str]
    eval: list[str]
    state: Literal["finished", "failed", "waiting"]
    subsets: NotRequired[dict[str, RateRow]]
    error: NotRequired[str]


class SweepResult(TypedDict):
    """The document that ``--json`` writes."""

    schema: int
    name: str
    out: str
    dry_run: bool
    finished: int
    failed: int
    waiting: int
    runs: list[RunRow]


def _summary(
    runs: Sequence[Run], out: Path, config: SweepConfig, outcomes: Mapping[str, RunOutcome]
) -> SweepResult:
    """Results are read from the folders, whichever run put them there."""
    rows = [_run_row(run, out / run.name, outcomes.get(run.name)) for run in runs]
    states = [row["state"] for row in rows]
    return {
        "schema": 1,
        "name": Path(config.file).stem,
        "out": str(out),
        "dry_run": config.dry_run,
        "finished": states.count("finished"),
        "failed": states.count("failed"),
        "waiting": states.count("waiting"),
        "runs": rows,
    }


def _run_row(run: Run, folder: Path, outcome: RunOutcome | None) -> RunRow:
    row: RunRow = {"name": run.name, "path": str(folder), **run.words(), "state": "waiting"}
    if why := broken(folder):
        return {**row, "state": "failed", "error": why}
    if finished(folder):
        return {**row, "state": "finished", "subsets": result_rows(folder)}
    if outcome is not None and outcome.state == "failed":
        return {**row, "state": "failed", "error": outcome.error}
    return row


def sweep_table(result: SweepResult) -> str:
    """A sweep as lines; failed runs come last, so that they are seen."""
    lines = [f"{result['name']}: {len(result['runs'])} runs in {result['out']}"]
    for run in sorted(result["runs"], key=lambda run: run["state"] == "failed"):
        rates = "  ".join(
            f"{subset} {rate['success']:.2f} (n={rate['n']})"
            for subset, rate in run.get("subsets", {}).items()
        )
        lines.append(f"  {run['state']:9} {run['name']}  {run.get('error', rates)}".rstrip())
    lines.append(
        f"{result['finished']} finished, {result['failed']} failed, {result['waiting']} waiting"
    )
    if result["failed"]:
        lines.append("the same command tries failed runs again and leaves finished ones alone")
    return "\n".join(lines)
