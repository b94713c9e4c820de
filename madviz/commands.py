"""The commands of ``madviz``: a line for each, in the order of ``madviz --help``.

A command is a frozen dataclass, which its options fill, and a function that takes it; both are the
Python API too. Names are written ``module:name`` and are only imported when the command is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Any


@dataclass(frozen=True)
class Command:
    """A line of the table."""

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
    default: str = ""
    """The function that makes a ``config`` of the words after the command: the values of options
    that are not given, and the class of each group of options. '' takes the class's own."""
    first: str = ""
    """The function that gets the words after the command before anything else is imported."""


COMMANDS: dict[str, Command] = {
    "explore": Command(
        "Serves the page: a policy at work, and cameras to take away from it.",
        "explore --policy metaworld-hammer-mad-light --port 8080",
        config="madviz.app.server:ExploreConfig",
        work="madviz.app.server:explore",
        first="madviz.app.forking:prepare_for",
    ),
    "train": Command(
        "Trains a policy by a recipe and prints its folder; can be stopped and resumed.",
        "train --task metaworld/hammer --method mad --recipe light --out runs/hammer",
        config="madviz.training.config:TrainConfig",
        default="madviz.training.config:default_config",
        work="madviz.training.train:train",
        words="builtins:str",
    ),
    "eval": Command(
        "Counts a policy's successes under camera subsets, on seeded episodes.",
        "eval --policy metaworld-hammer-mad-light --subsets all first --episodes 20",
        config="madviz.measure.evaluate:EvalConfig",
        work="madviz.measure.evaluate:run_eval",
        words="madviz.measure.evaluate:success_table",
    ),
    "audit": Command(
        "Does a policy use its cameras? Each one removed and alone, as a page with a verdict.",
        "audit --policy metaworld-hammer-mad-light --episodes 40 --out audit-hammer",
        config="madviz.measure.audit.audit:AuditConfig",
        work="madviz.measure.audit.audit:run_audit",
        words="madviz.measure.audit.audit:audit_words",
    ),
    "guard": Command(
        "Fits a policy's guard, which notices a camera that fails: for --guard of other commands.",
        "guard --policy metaworld-hammer-mad-light",
        config="madviz.measure.guard_fit:GuardConfig",
        work="madviz.measure.guard_fit:run_guard",
        words="madviz.measure.guard_fit:guard_words",
    ),
    "wiring": Command(
        "Is a served policy wired right? Tries what people get wrong, and says what helps.",
        "wiring --policy ws://127.0.0.1:8000 --wire wire.toml",
        config="madviz.measure.wiring.check:WiringConfig",
        work="madviz.measure.wiring.check:run_wiring",
        words="madviz.measure.wiring.check:wiring_words",
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
        config="madviz.envs.doctor:DoctorConfig",
        work="madviz.envs.doctor:examine",
        words="madviz.envs.doctor:in_words",
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
        config="madviz.measure.compare:CompareConfig",
        work="madviz.measure.compare:run_compare",
        words="madviz.measure.compare:comparison_table",
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
}
OTHERS = (
    "  --version   prints the version",
    "  --completion bash|fish|zsh   prints a script that completes commands, options and names:",
    "      madviz --completion bash > ~/.local/share/bash-completion/completions/madviz",
)
"""The options of ``madviz`` itself."""
MOVED = {
    "bench": "in a clone of the repository, run python -m benchmarks {}",
    "soak": "in a clone of the repository, run python -m benchmarks soak",
    "displace": "run madviz audit --along, for example --along third_a.right=-0.2:0.2",
}
"""Names that were commands once, and what to run instead; ``{}`` is the word that followed."""
