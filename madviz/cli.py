"""``madviz <command>``: thin verbs over the dataclasses and functions that are the Python API too.

The first word picks a verb, and only then is that verb's module imported: ``madviz --help`` needs
neither torch nor viser. A verb parses its frozen dataclass (tyro), calls one function and hands
over what that returns.

    exit code 0 only for success; 1 something failed (doctor: something needed is missing);
    2 the user's own mistake, in one line and without a traceback; 130 Ctrl-C
    --json FILE writes the result as JSON; --json - prints it, and then nothing else goes to
    standard output: whatever the work prints meanwhile, worker processes included, goes to stderr
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from madviz.errors import UserError, unknown
from madviz.evaluation.statistics import in_words
from madviz.system.files import pretty, write_json, written_to

Config = TypeVar("Config")
Verb = Callable[[Sequence[str]], int]


@dataclass(frozen=True)
class ListConfig:
    """Lists tasks, settings, methods and the policies that were found."""

    json: str | None = None
    """Write the list to this file; ``-`` is standard output, and then nothing else goes there."""


class HasJson(Protocol):
    @property
    def json(self) -> str | Path | None: ...


def explore(words: Sequence[str]) -> int:
    """Serves the page: a policy at work, and cameras to take away from it."""
    from madviz.app.server import ExploreConfig
    from madviz.app.server import explore as serve

    serve(parse(ExploreConfig, "explore", words))
    return 0


def train(words: Sequence[str]) -> int:
    """Trains a policy by a recipe and prints its folder; can be stopped and resumed."""
    from madviz.training.train import TrainConfig
    from madviz.training.train import train as run

    print(run(parse(TrainConfig, "train", words)))
    return 0


def evaluate(words: Sequence[str]) -> int:
    """Counts a policy's successes under camera subsets, on seeded episodes."""
    from madviz.evaluation.evaluate import EvalConfig, run_eval

    config = parse(EvalConfig, "eval", words)
    deliver(config, lambda: run_eval(config), success_table)
    return 0


def list_(words: Sequence[str]) -> int:
    """Lists tasks, settings, methods and policies."""
    from madviz.policies.checkpoint import list_everything

    deliver(parse(ListConfig, "list", words), list_everything, catalogue)
    return 0


def doctor(words: Sequence[str]) -> int:
    """Tells what is missing on this machine and the line that mends it; times a frame."""
    from madviz.doctor import DoctorConfig, examine, in_words

    config = parse(DoctorConfig, "doctor", words)
    return 0 if deliver(config, lambda: examine(config), in_words)["ok"] else 1


def bench(words: Sequence[str]) -> int:
    """Measures: bench render, live, update, buffer, evaluate."""
    return pick(BENCHMARKS, "benchmark", words, "madviz bench")


def bench_render(words: Sequence[str]) -> int:
    """A three-view Meta-World frame against stock MuJoCo flags."""
    from madviz.bench.render import RenderConfig
    from madviz.bench.render import bench_render as measure

    config = parse(RenderConfig, "bench render", words)
    deliver(config, lambda: measure(config), pretty)
    return 0


def bench_live(words: Sequence[str]) -> int:
    """The page in a real browser: updates a second, and how long a toggle takes."""
    from madviz.bench.live import LiveConfig
    from madviz.bench.live import bench_live as measure

    config = parse(LiveConfig, "bench live", words)
    deliver(config, lambda: measure(config), pretty)
    return 0


def bench_update(words: Sequence[str]) -> int:
    """One training update against a straightforward implementation."""
    from madviz.bench.update import BenchUpdateConfig
    from madviz.bench.update import bench_update as measure

    config = parse(BenchUpdateConfig, "bench update", words)
    deliver(config, lambda: measure(config), pretty)
    return 0


def bench_buffer(words: Sequence[str]) -> int:
    """The replay buffer packed against plain: bytes per transition, time for a batch."""
    from madviz.bench.buffer import BenchBufferConfig
    from madviz.bench.buffer import bench_buffer as measure

    config = parse(BenchBufferConfig, "bench buffer", words)
    deliver(config, lambda: measure(config), pretty)
    return 0


def bench_evaluate(words: Sequence[str]) -> int:
    """Episodes a minute of an evaluation, against a plain loop and a stock one."""
    from madviz.bench.evaluate import BenchEvaluateConfig
    from madviz.bench.evaluate import bench_evaluate as measure

    config = parse(BenchEvaluateConfig, "bench evaluate", words)
    deliver(config, lambda: measure(config), pretty)
    return 0


def sweep(words: Sequence[str]) -> int:
    """Trains and evaluates every combination in a small file; goes on after a kill."""
    from madviz.sweep.sweep import SweepConfig, run_sweep, sweep_table

    config = parse(SweepConfig, "sweep", words, positional=True)
    return 1 if deliver(config, lambda: run_sweep(config), sweep_table)["failed"] else 0


def compare(words: Sequence[str]) -> int:
    """Compares policies on the seeds they all met: difference, interval, exact p."""
    from madviz.evaluation.compare import CompareConfig, comparison_table, run_compare

    config = parse(CompareConfig, "compare", words, positional=True)
    deliver(config, lambda: run_compare(config), comparison_table)
    return 0


def report(words: Sequence[str]) -> int:
    """Writes RESULTS.md: tables and pictures of all evaluated policies, held against the paper."""
    from madviz.report.results import ReportConfig, report_words, run_report

    config = parse(ReportConfig, "report", words)
    deliver(config, lambda: run_report(config), report_words)
    return 0


def replay(words: Sequence[str]) -> int:
    """Lives kept episodes again; says whether they come out the same, to the bit."""
    from madviz.session.replay import ReplayConfig, replay_words, run_replay

    config = parse(ReplayConfig, "replay", words, positional=True)
    return 0 if deliver(config, lambda: run_replay(config), replay_words)["same"] else 1


def record(words: Sequence[str]) -> int:
    """Records an episode without a page: a rerun file, a film or a report."""
    from madviz.recording.record import RecordConfig, record_words, run_record

    config = parse(RecordConfig, "record", words)
    deliver(config, lambda: run_record(config), record_words)
    return 0


def soak(words: Sequence[str]) -> int:
    """Lets visitors come and go for an hour; says whether anything is left of them."""
    from madviz.bench.soak import SoakConfig, soak_words
    from madviz.bench.soak import soak as run

    config = parse(SoakConfig, "soak", words)
    return 0 if deliver(config, lambda: run(config), soak_words)["ok"] else 1


def displace(words: Sequence[str]) -> int:
    """Moves a camera away from where a policy was trained: success against distance."""
    from madviz.evaluation.displace import DisplaceConfig, displacement_table, run_displace

    config = parse(DisplaceConfig, "displace", words)
    deliver(config, lambda: run_displace(config), displacement_table)
    return 0


VERBS: dict[str, Verb] = {
    **{"explore": explore, "train": train, "eval": evaluate, "list": list_},
    **{"doctor": doctor, "bench": bench},
    **{"sweep": sweep, "compare": compare, "report": report},
    **{"record": record, "replay": replay, "soak": soak, "displace": displace},
}
BENCHMARKS: dict[str, Verb] = {
    **{"render": bench_render, "live": bench_live, "update": bench_update},
    **{"buffer": bench_buffer, "evaluate": bench_evaluate},
}


def main(words: Sequence[str] | None = None) -> int:
    """Runs one command; the exit code."""
    if sys.platform == "linux":
        # MuJoCo reads this while it is imported, and its own default needs a display.
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        return pick(VERBS, "command", sys.argv[1:] if words is None else words, "madviz")
    except UserError as error:
        print(f"madviz: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("madviz: stopped", file=sys.stderr)
        return 130


def pick(verbs: Mapping[str, Verb], kind: str, words: Sequence[str], prog: str) -> int:
    """Hands the words after the first to the verb that the first one names."""
    if not words or words[0] in ("-h", "--help"):
        print(usage(verbs, prog), file=sys.stdout if words else sys.stderr)
        return 0 if words else 2
    if words[0] not in verbs:
        raise unknown(kind, words[0], list(verbs))
    return verbs[words[0]](words[1:])


def usage(verbs: Mapping[str, Verb], prog: str) -> str:
    """A line for every verb: its docstring's first."""
    lines = [f"usage: {prog} COMMAND [options]     ({prog} COMMAND --help lists them)", ""]
    for name, verb in verbs.items():
        lines.append(f"  {name:9} {(verb.__doc__ or '').splitlines()[0]}")
    return "\n".join(lines)


def parse(
    config: type[Config], command: str, words: Sequence[str], positional: bool = False
) -> Config:
    """The dataclass ``config`` filled from the command line; leaves with code 2 if that fails.
    With ``positional``, what has no default is given without its name: ``madviz sweep FILE``."""
    import tyro

    markers = (tyro.conf.PositionalRequiredArgs,) if positional else ()
    return tyro.cli(config, prog=f"madviz {command}", args=list(words), config=markers)


def deliver(
    config: HasJson,
    work: Callable[[], dict[str, Any]],
    in_words: Callable[[dict[str, Any]], str],
) -> dict[str, Any]:
    """Does the work and hands its result over where ``config.json`` says; returns it."""
    if str(config.json) == "-":
        with printing_to_stderr():
            result = work()
        sys.stdout.write(pretty(result))
        return result
    if config.json is not None:
        written_to(Path(config.json), "--json")
    result = work()
    if config.json is not None:
        write_json(Path(config.json), result)
    print(in_words(result))
    return result


@contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Sends standard output to standard error meanwhile, also what C libraries and child processes
    print: the file descriptor itself is exchanged."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def success_table(result: dict[str, Any]) -> str:
    """An evaluation as lines: subset, success with its interval, episodes."""
    lines = [f"{result['policy']} on {result['task']}: success {result['definition']}"]
    for name, row in result["subsets"].items():
        lines.append(
            f"  {name:24} {in_words(row['success'], row['ci95'], row['n'])}"
            f"   any step {row['success_any']:.2f}" + ("" if row["trained"] else "   off-training")
        )
    return "\n".join(lines)


def catalogue(listed: dict[str, Any]) -> str:
    """The list as lines; a policy's line carries its success on all cameras, if it was measured."""
    lines = [f"{word}: {', '.join(listed[word])}" for word in ("tasks", "settings", "methods")]
    lines.append("policies:" if listed["policies"] else "policies: none found")
    for policy in [*listed["policies"], *listed["without_weights"]]:
        whole = policy["success"].get("all")
        rate = f"all {whole['success']:.2f} (n={whole['n']})" if whole else "not evaluated"
        weights = "" if policy["weights"] else "   no weights"
        lines.append(f"  {policy['name']:44} {policy['task']:24} {rate}{weights}")
    lines += [f"  broken: {each['error']}" for each in listed.get("broken", [])]
    return "\n".join(lines)
