"""One run of a sweep: train, then evaluate, in a folder that says how far it got.

    OUT/NAME/run.json        the words of its two commands; another sweep file must not mix in
    OUT/NAME/policy/         the policy folder, and what its training needs to be resumed
    OUT/NAME/log.txt         everything the two commands printed
    OUT/NAME/claim           locked while a process works here
    OUT/NAME/measured.json   what its evaluation wrote, until the result is there
    OUT/NAME/result.json     written last, whole or not at all: the run is finished

All state is in the folder, so any process may carry a run out at any time: the same sweep again
after a kill, a second sweep beside it, another machine that shares the folder. The claim is an
advisory lock of the operating system that the commands inherit. It ends when the last process that
holds it ends: if the supervisor is killed and its training runs on for a moment, the next
supervisor finds the claim taken, comes back later, and then resumes. Commands also get SIGTERM when
their supervisor dies, so that moment is short (on Linux; elsewhere they finish, and hold their
claim until then).
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict

from madviz.errors import UserError
from madviz.policies.checkpoint import CONFIG, IN_RUN
from madviz.policies.measured import RateRow
from madviz.system.files import read_json, read_rows, write_json
from madviz.system.lock import locked
from madviz.system.typed import typed

RESULT = "result.json"
MEASURED = "measured.json"
WORDS = "run.json"
LOG = "log.txt"
CLAIM = "claim"
State = Literal["finished", "failed", "busy", "stopped"]
POLL_SECONDS = 0.1
FIX = "restore it, or remove the run's folder"

END_WITH_PARENT = (
    "import ctypes, os, signal, sys\n"
    "if sys.platform == 'linux': ctypes.CDLL(None).prctl(1, int(signal.SIGTERM))\n"
    "if os.getppid() != int(sys.argv[1]): sys.exit(143)\n"
    "os.execvp(sys.argv[2], sys.argv[2:])"
)
"""Asks Linux for SIGTERM at the death of the parent (PR_SET_PDEATHSIG is 1), checks that it is not
dead already, and becomes the command. The request survives the exec."""


class RunWords(TypedDict):
    """run.json: the words of the two commands."""

    train: list[str]
    eval: list[str]


@dataclass(frozen=True)
class Run:
    """One line of a sweep. Same run, same words, wherever it is carried out."""

    name: str
    train: tuple[str, ...]
    """The words after ``madviz train``, without ``--out`` and ``--resume``."""
    evaluate: tuple[str, ...]
    """The words after ``madviz eval``, without ``--policy``."""

    def words(self) -> RunWords:
        """The content of run.json."""
        return {"train": list(self.train), "eval": list(self.evaluate)}


class RunResult(TypedDict):
    """The part of result.json and of an evaluation that a summary reads."""

    subsets: dict[str, RateRow]


class TrainedConfig(TypedDict):
    """The part of config.json that a sweep reads."""

    training: NotRequired[dict[str, Any]]


@dataclass(frozen=True)
class RunOutcome:
    """How an attempt at a run ended."""

    state: State
    """``busy``: another process works on it; ``stopped``: this one was asked to stop."""
    error: str = ""
    seconds: float = 0.0
    """Seconds of work in this attempt."""


def finished(folder: Path) -> bool:
    """Whether the run in ``folder`` needs no more work."""
    return (folder / RESULT).is_file()


def broken(folder: Path) -> str:
    """``broken: ...``, where run.json or result.json holds something else; '' where they are sound
    or not there."""
    try:
        _words_before(folder)
        if finished(folder):
            result_rows(folder)
    except UserError as error:
        return f"broken: {error}"
    return ""


def check_same(folder: Path, run: Run) -> None:
    """Raises UserError if ``folder`` holds a run of that name with other options, as far as they
    were carried out: those of a command that did nothing yet may be corrected."""
    before = _words_before(folder)
    if before is None:
        return
    policy = folder / IN_RUN
    began = (policy / CONFIG).is_file() or (policy / "resume" / "run.json").is_file()
    for command, asked, done in (
        ("train", run.train, began),
        ("eval", run.evaluate, finished(folder)),
    ):
        options = before.get(command, [])
        if done and options != list(asked):
            raise UserError(
                f"{folder}: expected a run of `madviz {command} {shlex.join(asked)}`, found one of "
                f"`madviz {command} {shlex.join(options)}`; choose another --out"
            )


def _words_before(folder: Path) -> dict[str, list[str]] | None:
    file = folder / WORDS
    return typed(read_json(file), dict[str, list[str]], file, FIX) if file.is_file() else None


def result_rows(folder: Path) -> dict[str, RateRow]:
    """The subsets of a finished run. Raises UserError for a file that is none."""
    file = folder / RESULT
    return typed(read_json(file), RunResult, file, FIX)["subsets"]


def carry_out(
    run: Run,
    out: Path,
    program: Sequence[str] = (),
    workers: int | None = None,
    stop: threading.Event | None = None,
) -> RunOutcome:
    """Does what is left of ``run`` in ``out/run.name``. Never raises for what goes wrong inside.

    ``program`` stands for ``madviz`` (by default this Python's), ``workers`` for the processes of
    its evaluation, which change no result. ``stop`` ends the commands with
    SIGTERM.
    """
    folder = out / run.name
    began = time.monotonic()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if why := broken(folder):
            return RunOutcome("failed", why)
        if finished(folder):
            check_same(folder, run)
            return RunOutcome("finished")
        with locked(folder / CLAIM) as claim:  # None: another process holds it.
            if claim is None:
                return RunOutcome("busy")
            check_same(folder, run)
            if not finished(folder):
                commands = _Commands(folder, program, claim, stop or threading.Event())
                _work(run, folder, commands, workers)
    except _Stopped:
        return RunOutcome("stopped", seconds=time.monotonic() - began)
    except (UserError, OSError) as error:
        return RunOutcome("failed", str(error), time.monotonic() - began)
    return RunOutcome("finished", seconds=time.monotonic() - began)


def _work(run: Run, folder: Path, commands: _Commands, workers: int | None) -> None:
    write_json(folder / WORDS, run.words())
    policy = folder / IN_RUN
    if not trained(policy):
        resume = ["--resume"] if (policy / "resume" / "run.json").is_file() else []
        commands.run("train", *run.train, "--out", str(policy), *resume)
        if not trained(policy):
            raise UserError(f"training ended before it was finished; see {folder / LOG}")
    extra = [] if workers is None else ["--workers", str(workers)]
    file = folder / MEASURED  # The card may have other seeds, or subsets measured before.
    options = ["--policy", str(policy), *run.evaluate, "--card", "--json", str(file), *extra]
    commands.run("eval", *options)
    evaluation = read_json(file)
    typed(evaluation, RunResult, file, FIX)
    result = {"schema": 1, "name": run.name, **run.words(), "subsets": evaluation["subsets"]}
    write_json(folder / RESULT, result)
    file.unlink()


def trained(policy: Path) -> bool:
    """Returns True if the policy's config says that its training reached the end, and nothing of
    it, such as the last evaluation, is left to resume."""
    resume = policy / "resume"
    goes_on = (resume / "run.json").is_file() and not (resume / "finished").is_file()
    if goes_on or not (policy / CONFIG).is_file():
        return False
    config = typed(read_json(policy / CONFIG), TrainedConfig, policy / CONFIG, FIX)
    return bool(config.get("training", {}).get("finished", True))


def expected_seconds(folder: Path) -> float | None:
    """The total time that the run's training predicts; None before it says so."""
    file = folder / IN_RUN / "curve.csv"
    try:
        *_, last = read_rows(file)
        return float(last["seconds"]) + float(last["seconds_left"])
    except (OSError, ValueError, KeyError, TypeError):
        return None  # Not begun, half a row, or a recipe that does not know.


class _Stopped(Exception):
    """This process was asked to stop, and the command has ended."""


class _Commands:
    """Runs commands one after another with their output in the log."""

    def __init__(
        self, folder: Path, program: Sequence[str], claim: int, stop: threading.Event
    ) -> None:
        self._folder = folder
        self._claim = claim
        self._stop = stop
        self._program = list(program) or [sys.executable, "-m", "madviz"]

    def run(self, verb: str, *options: str) -> None:
        """Raises UserError with the command's last line if it fails, _Stopped when asked to."""
        if self._stop.is_set():
            raise _Stopped
        starter = [sys.executable, "-I", "-S", "-c", END_WITH_PARENT, str(os.getpid())]
        log = self._folder / LOG
        with log.open("ab") as file:
            file.write(f"$ {shlex.join(['madviz', verb, *options])}\n".encode())
            file.flush()
            process = subprocess.Popen(
                [*starter, *self._program, verb, *options],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                pass_fds=(self._claim,),
                start_new_session=True,  # Ctrl-C reaches it through us, once.
            )
            code = self._wait(process)
        if self._stop.is_set():
            raise _Stopped
        if code != 0:
            raise UserError(f"madviz {verb} {_how(code)}: {_last_line(log)}; see {log}")

    def _wait(self, process: subprocess.Popen[bytes]) -> int:
        asked = False
        while True:
            if self._stop.is_set() and not asked:
                process.terminate()
                asked = True
            try:
                return process.wait(POLL_SECONDS)
            except subprocess.TimeoutExpired:
                continue


def _how(code: int) -> str:
    return f"ended with {code}" if code > 0 else f"was ended by {signal.Signals(-code).name}"


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].strip() if lines else "it printed nothing"
