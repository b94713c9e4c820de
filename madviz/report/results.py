"""``madviz report``: RESULTS.md, rates.csv, pictures and sweep files, from policy folders alone.

    config.json       ->  evidence.py  ->  tables.py     ->  results_page.py  RESULTS.md
    evaluation.json       episodes         threshold.py      pictures.py      pictures/*.svg
    development.json                                         rates_csv.py     rates.csv
    curve.csv                                                sweeps.py        sweeps/*.toml

Nothing is typed, and without ``--evaluate`` nothing is run: the same files give the same bytes, so
that a committed RESULTS.md can be checked against what it was made from (the repository's own has a
table of claims before that, by ``tools/fill_figures.py``). Tables for which there are
no files yet are left out; a task without a policy stays in the first table, as not trained.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

from madviz.errors import UserError
from madviz.measure.evidence import Evidence, find_evidence
from madviz.policies.listing import BrokenRow
from madviz.policies.seeds import FIRST_TRY, MEASURED, use_of
from madviz.report import pictures
from madviz.report.evaluate import EPISODES, evaluate_all
from madviz.report.layouts import BASELINES, LAYOUTS
from madviz.report.rates_csv import rates_csv
from madviz.report.results_page import page
from madviz.report.sweeps import is_sweep_of_a_table, sweep_text
from madviz.report.tables import ResultTable, build
from madviz.report.threshold import TWENTY, Verdict, judge, verdict_json
from madviz.system.files import write_bytes, written_to
from madviz.system.numbers import Count, ThreadsOrNone

SHIPPED = (Path("checkpoints"), Path("results"))
"""Policies with weights, and those without; the page goes into the last."""


@dataclass(frozen=True)
class ReportConfig:
    """Writes RESULTS.md with tables and pictures of all policies that were evaluated."""

    folder: Path | None = None
    """Where the policy folders are, at any depth; checkpoints and results if not given."""
    out: Path | None = None
    """The file to write; FOLDER/RESULTS.md if not given. Pictures go to pictures/ beside it, sweep
    files to sweeps/, and all rates to rates.csv."""
    evaluate: bool = False
    """First evaluate every policy that has weights on the reporting seeds. What was measured before
    goes to development.json. Goes on where it was stopped."""
    episodes: Count = EPISODES
    """With --evaluate: episodes for each subset, from seed 40000 on."""
    workers: ThreadsOrNone | None = None
    """With --evaluate: processes; by default one per core. 0 runs everything in this one."""
    json: str | None = None
    """Where to write what was written, and which tasks meet the threshold; - is standard output."""


class ReportResult(TypedDict):
    """The document that ``--json`` writes."""

    schema: int
    path: str
    pictures: list[str]
    policies: int
    broken: list[BrokenRow]
    tables: list[str]
    bar: list[dict[str, Any]]
    """The acceptance threshold, task by task, see ``verdict_json``."""


def run_report(config: ReportConfig) -> ReportResult:
    """``madviz report``. Policies whose files are broken or contradict each other are named and
    left out. Raises UserError for a folder without evaluated policies, and for rates on seeds that
    must not be reported."""
    folders = SHIPPED if config.folder is None else (config.folder,)
    out = config.out or folders[-1] / "RESULTS.md"
    written_to(out, "--out")
    if config.evaluate:
        evaluate_all(folders, config.episodes, config.workers)
    evidence, broken = find_evidence(*folders)
    if not evidence:
        raise UserError(
            f"expected policy folders with evaluation.json in {' and '.join(map(str, folders))}, "
            "found none; run `madviz eval --policy NAME --card`"
            + "".join(f"; {row['name']} broken: {row['error']}" for row in broken)
        )
    for policy in evidence:
        check_seeds(policy)
    tables = [table for layout in LAYOUTS for table in build(layout, evidence)]
    compared = build(BASELINES, evidence)
    verdicts = [judge(task, evidence) for task in TWENTY]
    drawn = _drawn(evidence, verdicts, tables, compared)
    sweeps = out.parent / "sweeps"
    text = page(_remake(config, out), evidence, verdicts, tables, drawn, sweeps.as_posix())
    _write_all(out.parent / "pictures", drawn, pictures.is_ours)
    _write_all(sweeps, _sweeps(sweeps, verdicts, tables), is_sweep_of_a_table)
    write_bytes(out.parent / "rates.csv", rates_csv(verdicts, [*tables, *compared]).encode())
    write_bytes(out, text.encode())
    return {
        "schema": 1,
        "path": str(out),
        "pictures": [str(out.parent / "pictures" / name) for name in drawn],
        "policies": len(evidence),
        "broken": broken,
        "tables": [table.name for table in tables],
        "bar": [verdict_json(verdict) for verdict in verdicts],
    }


def check_seeds(evidence: Evidence) -> None:
    """Raises UserError unless every file holds seeds of one use that rates may have, and
    development.json no reporting seeds."""
    earlier = use_of(seed for outcomes in evidence.development.values() for seed in outcomes)
    if evidence.seeds not in MEASURED or earlier not in ("", *MEASURED[1:]):
        raise UserError(
            f"{evidence.path}: expected seeds of one use that rates may have ({', '.join(MEASURED)}"
            ") in evaluation.json, and none for reporting in development.json, found seeds for "
            f"{evidence.seeds} and for {earlier or 'nothing'}; evaluate again: `madviz eval --card "
            f"--seed {FIRST_TRY}`"
        )


def _remake(config: ReportConfig, out: Path) -> str:
    """The command that writes the same files."""
    folder = [] if config.folder is None else ["--folder", config.folder.as_posix()]
    written = [] if config.out is None else ["--out", out.as_posix()]
    return shlex.join(["madviz", "report", *folder, *written])


def _drawn(
    evidence: Sequence[Evidence],
    verdicts: Sequence[Verdict],
    tables: Sequence[ResultTable],
    compared: Sequence[ResultTable],
) -> dict[str, str]:
    """The pictures by name."""
    drawn = {}
    if any(verdict.row for verdict in verdicts):
        drawn[pictures.TWENTY] = pictures.twenty(verdicts)
    if compared:
        drawn[pictures.METHODS] = pictures.methods(compared)
    drawn |= pictures.curves(evidence)
    return {**drawn, **{f"{table.name}.svg": pictures.rates(table) for table in tables}}


def _sweeps(
    folder: Path, verdicts: Sequence[Verdict], tables: Sequence[ResultTable]
) -> dict[str, str]:
    """A sweep file for each question."""
    used = {"twenty": [policy for v in verdicts if v.row for policy in v.row.evidence]}
    for table in tables:
        used.setdefault(table.layout.key, []).extend(table.evidence)
    return {
        f"{key}.toml": sweep_text((folder / f"{key}.toml").as_posix(), policies)
        for key, policies in used.items()
        if policies
    }


def _write_all(folder: Path, files: Mapping[str, str], ours: Callable[[Path], bool]) -> None:
    """Writes ``files`` by name, and removes those that an earlier report wrote of tables that are
    gone; ``ours`` knows them."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in sorted(set(folder.iterdir()) - {folder / name for name in files}):
        if ours(old):
            old.unlink()
    for name, text in files.items():
        write_bytes(folder / name, text.encode())


def report_words(result: ReportResult) -> str:
    """The written files, as lines."""
    met = sum(verdict["verdict"] == "met" for verdict in result["bar"])
    lines = [
        f"{result['path']}: {result['policies']} policies, {len(result['tables'])} tables, "
        f"{len(result['pictures'])} pictures; {met} of {len(result['bar'])} tasks meet the "
        "acceptance threshold"
    ]
    lines += [f"{row['name']} broken: {row['error']}" for row in result["broken"]]
    return "\n".join(lines)
