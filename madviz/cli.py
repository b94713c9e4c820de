"""``madviz COMMAND``: one table over the dataclasses and functions that are the Python API too.

The first word picks a line of ``COMMANDS``, and only then are its modules imported: ``madviz
--help`` needs neither torch nor viser. The options fill a frozen dataclass (tyro), one function
works on it, and what that returns is handed over.

    exit code 0 only for success; 1 something failed (doctor: something needed is missing);
    2 the user's own mistake, in one line and without a traceback; 130 Ctrl-C; 143 SIGTERM. A
    reader of standard output who leaves (``| head -1``) changes none of them
    --json FILE writes the result as JSON; --json - prints it, and then nothing else goes to
    standard output: whatever the work prints meanwhile, worker processes included, goes to stderr
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any

from madviz import __version__
from madviz.errors import Interrupted, NotWritten, Unfinished, UserError, saving, signal_of, unknown
from madviz.system.command_line import completion, read
from madviz.system.files import pretty, write_json, written_to
from madviz.system.signals import terminable
from madviz.system.streams import open_standard_streams, say, telling


@dataclass(frozen=True)
class Command:
    """A line of the table. Names are written ``module:name`` and are only imported when the command
    is used."""

    summary: str
    example: str
    """Words after ``madviz`` that do something useful."""
    config: str
    """The frozen dataclass that the options fill."""
    work: str
    """The function that takes it."""
    words: str = ""
    """The function that puts the result into words; '' prints nothing."""
    ok: Callable[[Any], bool] = lambda result: True
    """Whether the result is a success: exit code 0, or 1."""
    positional: bool = False
    """Whether what has no default is given without its name: ``madviz sweep FILE``."""


PRETTY = "madviz.system.files:pretty"
COMMANDS: dict[str, Command] = {
    "explore": Command(
        "Serves the page: a policy at work, and cameras to take away from it.",
        "explore --policy metaworld-hammer-mad-light --port 8080",
        config="madviz.app.server:ExploreConfig",
        work="madviz.app.server:explore",
    ),
    "train": Command(
        "Trains a policy by a recipe and prints its folder; can be stopped and resumed.",
        "train --task metaworld/hammer --method mad --recipe light --out runs/hammer",
        config="madviz.training.config:TrainConfig",
        work="madviz.training.train:train",
        words="builtins:str",
    ),
    "eval": Command(
        "Counts a policy's successes under camera subsets, on seeded episodes.",
        "eval --policy metaworld-hammer-mad-light --subsets all first --episodes 20",
        config="madviz.evaluation.evaluate:EvalConfig",
        work="madviz.evaluation.evaluate:run_eval",
        words="madviz.evaluation.evaluate:success_table",
    ),
    "audit": Command(
        "Does a policy use its cameras? Each one removed and alone, as a page with a verdict.",
        "audit --policy metaworld-hammer-mad-light --episodes 40 --out audit-hammer",
        config="madviz.auditing.audit:AuditConfig",
        work="madviz.auditing.audit:run_audit",
        words="madviz.auditing.audit:audit_words",
    ),
    "list": Command(
        "Lists tasks, settings, methods and policies.",
        "list --json list.json",
        config="madviz.policies.listing:ListConfig",
        work="madviz.policies.listing:run_list",
        words="madviz.policies.listing:catalogue",
    ),
    "doctor": Command(
        "Says what is missing on this machine and the command that fixes it; times a frame.",
        "doctor --task maniskill/push-cube",
        config="madviz.doctor:DoctorConfig",
        work="madviz.doctor:examine",
        words="madviz.doctor:in_words",
        ok=itemgetter("ok"),
    ),
    "sweep": Command(
        "Trains and evaluates every combination in a small file; resumes after a kill.",
        "sweep results/sweeps/merging.toml --out runs/merging --dry-run",
        config="madviz.sweep.sweep:SweepConfig",
        work="madviz.sweep.sweep:run_sweep",
        words="madviz.sweep.sweep:sweep_table",
        ok=lambda result: not result["failed"],
        positional=True,
    ),
    "compare": Command(
        "Compares policies on the seeds they share: difference, interval, exact p.",
        "compare metaworld-hammer-mad-light metaworld-hammer-merged-only-light",
        config="madviz.evaluation.compare:CompareConfig",
        work="madviz.evaluation.compare:run_compare",
        words="madviz.evaluation.compare:comparison_table",
        ok=lambda result: not result["broken"],
        positional=True,
    ),
    "report": Command(
        "Writes RESULTS.md: tables and figures of all evaluated policies, beside the paper's.",
        "report --folder runs --out runs/RESULTS.md",
        config="madviz.report.results:ReportConfig",
        work="madviz.report.results:run_report",
        words="madviz.report.results:report_words",
    ),
    "record": Command(
        "Records an episode without a page: a rerun file, a video or an HTML report.",
        "record --policy metaworld-hammer-mad-light --drop first@20-40 --out hammer.mp4",
        config="madviz.recording.record:RecordConfig",
        work="madviz.recording.record:run_record",
        words="madviz.recording.record:record_words",
    ),
    "replay": Command(
        "Replays saved sessions; says whether they come out the same, to the bit.",
        "replay hammer-seed2003.json",
        config="madviz.session.replay:ReplayConfig",
        work="madviz.session.replay:run_replay",
        words="madviz.session.replay:replay_words",
        ok=itemgetter("same"),
        positional=True,
    ),
    "serve": Command(
        "Serves a policy to other programs: the protocols of vla-eval and openpi.",
        "serve --policy metaworld-hammer-mad-light --port 8000",
        config="madviz.serving.serve:ServeConfig",
        work="madviz.serving.serve:run_serve",
    ),
    "site": Command(
        "Writes the explorer as static files: simulator and policy in the visitor's browser.",
        "site --out build/site --policies metaworld-hammer-mad-light",
        config="madviz.site.site:SiteConfig",
        work="madviz.site.site:run_site",
        words="madviz.site.site:site_words",
    ),
    "grade": Command(
        "Grades a folder of returned notebooks: each exercise a row, whatever a copy does.",
        "grade returned --lessons build/class/student --out grades.csv",
        config="madviz.grading.grade:GradeConfig",
        work="madviz.grading.grade:grade",
        words="madviz.grading.grade:grade_words",
        positional=True,
    ),
    "displace": Command(
        "Moves a camera away from where a policy was trained: success against distance.",
        "displace --policy metaworld-hammer-mad-light --camera third_a --svg moved.svg",
        config="madviz.evaluation.displace:DisplaceConfig",
        work="madviz.evaluation.displace:run_displace",
        words="madviz.evaluation.displace:displacement_table",
    ),
    "soak": Command(
        "Lets visitors come and go for an hour; says whether the server has grown.",
        "soak --minutes 3 --visitors 2",
        config="madviz.bench.soak:SoakConfig",
        work="madviz.bench.soak:soak",
        words="madviz.bench.soak:soak_words",
        ok=itemgetter("ok"),
    ),
    "bench render": Command(
        "A three-view frame against the simulator's stock settings.",
        "bench render --suite metaworld",
        config="madviz.bench.render:RenderConfig",
        work="madviz.bench.render:bench_render",
        words=PRETTY,
    ),
    "bench live": Command(
        "The page in a real browser: updates a second, and how long a toggle takes.",
        "bench live --seconds 10 --toggles 30",
        config="madviz.bench.live:LiveConfig",
        work="madviz.bench.live:bench_live",
        words=PRETTY,
    ),
    "bench crowd": Command(
        "Visitors with a simulation each: decisions a second, cores, memory.",
        "bench crowd --visitors 1 4 8",
        config="madviz.bench.crowd:CrowdConfig",
        work="madviz.bench.crowd:bench_crowd",
        words=PRETTY,
    ),
    "bench imagine": Command(
        "What a masked autoencoder draws of a camera that is missing, against two controls.",
        "bench imagine --task toy/reach --training.updates 2000",
        config="madviz.bench.imagine:ImagineConfig",
        work="madviz.bench.imagine:bench_imagine",
        words="madviz.bench.imagine:imagine_words",
    ),
    "bench places": Command(
        "Where the task's objects are, read from each camera's feature, against two controls.",
        "bench places --policy metaworld-hammer-mad-light",
        config="madviz.bench.places:PlacesConfig",
        work="madviz.bench.places:bench_places",
        words="madviz.bench.places:places_words",
    ),
    "bench update": Command(
        "One training update against a straightforward implementation.",
        "bench update --batch-size 64 --hidden-dim 512",
        config="madviz.bench.update:BenchUpdateConfig",
        work="madviz.bench.update:bench_update",
        words=PRETTY,
    ),
    "bench buffer": Command(
        "The replay buffer packed against plain: bytes per transition, time for a batch.",
        "bench buffer --decisions 400 --rounds 5",
        config="madviz.bench.buffer:BenchBufferConfig",
        work="madviz.bench.buffer:bench_buffer",
        words=PRETTY,
    ),
    "bench evaluate": Command(
        "Episodes a minute of an evaluation, against a plain loop and a stock one.",
        "bench evaluate --episodes 8 --workers 2",
        config="madviz.bench.evaluate:BenchEvaluateConfig",
        work="madviz.bench.evaluate:bench_evaluate",
        words=PRETTY,
    ),
    "bench site": Command(
        "A site in a real browser: megabytes, decisions a second, success by subset.",
        "bench site --site build/site --episodes 20",
        config="madviz.bench.site:BenchSiteConfig",
        work="madviz.bench.site:bench_site",
        words=PRETTY,
    ),
}
"""In the order of ``madviz --help``; a name of two words is a command of a group."""
OTHERS = (
    "  --version   prints the version",
    "  --completion bash|fish|zsh   prints a script that completes commands, options and names:",
    "      madviz --completion bash > ~/.local/share/bash-completion/completions/madviz",
)
"""The options of ``madviz`` itself."""
GROUPS = {
    "bench": "Measures: bench render, live, crowd, imagine, places, update, buffer, evaluate, site."
}


def main(words: Sequence[str] | None = None) -> int:
    """Runs one command; the exit code."""
    open_standard_streams()
    if sys.platform == "linux":
        # MuJoCo reads this while it is imported, and its own default needs a display.
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        with terminable():
            return run(sys.argv[1:] if words is None else words)
    except UserError as error:
        say(f"madviz: {error}")
        return 2
    except Interrupted as stopped:
        say(f"madviz: stopped; {stopped}")
        return stopped.exit_code
    except KeyboardInterrupt as stopped:
        say("madviz: stopped")
        return 128 + signal_of(stopped)
    except OSError as error:
        if error.filename is None:
            raise
        say(f"madviz: {error.filename!s:.200}: {error.strerror}")
        return 2


def run(words: Sequence[str], group: str = "") -> int:
    """Runs the command that the first word names, within ``group`` if one is given. Raises
    UserError for an unknown one."""
    first, rest = (words[0], words[1:]) if words else ("", ())
    if first in ("", "-h", "--help"):
        if not first:
            say(usage(group))
            return 2
        with telling():
            print(usage(group))
        return 0
    if first == "--version" and not group:
        with telling():
            print(f"madviz {__version__}")
        return 0
    if first == "--completion" and not group:
        with telling():
            print(script_of(rest[0] if rest else ""))
        return 0
    if first not in summaries(group):
        raise unknown("benchmark" if group else "command", first, list(summaries(group)))
    if first in GROUPS and not group:
        return run(rest, first)
    name = f"{group} {first}".strip()
    command = COMMANDS[name]
    try:
        config, work = parse(name, rest), named(command.work)
        in_words = named(command.words) if command.words else None
    except KeyboardInterrupt as stopped:
        raise Interrupted("", signal_of(stopped)) from stopped
    return 0 if command.ok(deliver(config, work, in_words)) else 1


def named(reference: str) -> Any:
    """What ``module:name`` of the table stands for."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def summaries(group: str = "") -> dict[str, str]:
    """What can follow ``madviz``, or ``madviz bench``, and what each of it does."""
    lines = {name: command.summary for name, command in COMMANDS.items()}
    if group:
        start = f"{group} "
        return {n.removeprefix(start): line for n, line in lines.items() if n.startswith(start)}
    return {name: line for name, line in lines.items() if " " not in name} | GROUPS


def usage(group: str = "") -> str:
    """A line for every command."""
    prog = f"madviz {group}".strip()
    lines = [f"usage: {prog} COMMAND [options]     ({prog} COMMAND --help lists them)", ""]
    lines += [f"  {name:9} {summary}" for name, summary in summaries(group).items()]
    return "\n".join(lines if group else [*lines, "", *OTHERS])


def parse(name: str, words: Sequence[str]) -> Any:
    """The configuration of the command ``name``, filled from ``words``, or the end (``read``)."""
    command = COMMANDS[name]
    config, example = named(command.config), f"madviz {command.example}"
    return read(config, words, f"madviz {name}", command.summary, example, command.positional)


def script_of(shell: str) -> str:
    """The script by which ``shell`` completes what follows ``madviz``."""
    configs: dict[str, Any] = {}
    for name, command in COMMANDS.items():
        group, _, alone = name.rpartition(" ")
        (configs.setdefault(group, {}) if group else configs)[alone] = named(command.config)
    return completion(shell, "madviz", configs)


def deliver(
    config: Any, work: Callable[[Any], Any], in_words: Callable[[Any], str] | None = None
) -> Any:
    """Does ``work(config)`` and hands its result over: as JSON where ``config.json`` says if there
    is such an option, and printed by ``in_words``. Returns the result."""
    place: str | None = getattr(config, "json", None)
    if place == "-":
        with printing_to_stderr():
            result, unwritten = worked(config, work)
        with telling():
            sys.stdout.write(pretty(result))
    else:
        if place is not None:
            written_to(Path(place), "--json")
        result, unwritten = worked(config, work)
        if place is not None:
            try:
                with saving(result, f"--json {place}"):
                    write_json(Path(place), result)
            except NotWritten as error:
                unwritten = unwritten or error
        with telling():
            if in_words is not None:
                print(in_words(result))
            if isinstance(unwritten, NotWritten):
                sys.stdout.write(pretty(result))
    if unwritten:
        raise unwritten
    return result


def worked(config: Any, work: Callable[[Any], Any]) -> tuple[Any, NotWritten | Unfinished | None]:
    """The result of ``work(config)``, also if some of it could not be written or is not there, and
    that error."""
    try:
        return work(config), None
    except (NotWritten, Unfinished) as error:
        return error.result, error


@contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Sends standard output to standard error meanwhile, also what C libraries and child processes
    print: the file descriptor itself is exchanged."""
    sys.stdout.flush()
    saved = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
