"""``madviz report``: RESULTS.md and its pictures, from the files of the policy folders alone.

    config.json, evaluation.json  ->  evidence.py  ->  tables.py  ->  claims.py
                                      episodes         the paper's tables    and its sentences

What was tried on the way to a policy leaves no policy folder; ``tried.json`` beside the folders
says it: a list of sentences for each task. Nothing else is typed and nothing is run: the same
files give the same bytes, so that a committed RESULTS.md can be held against what it was made
from. Tables for which there are no files yet are left out; a task without a policy stays in the
first table, as not trained.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from madviz import svg
from madviz.card import AGAIN, train_again
from madviz.checkpoint import WEIGHTS
from madviz.envs.base import MANISKILL_TASKS, METAWORLD_TASKS
from madviz.files import write_bytes
from madviz.report.claims import claims
from madviz.report.evidence import Evidence, find_evidence
from madviz.report.layouts import LAYOUTS, THREE
from madviz.report.rows import Rate, Row
from madviz.report.tables import Table, build, usual_alphas
from madviz.statistics import in_words
from madviz.types import UserError

TWENTY = (
    *(f"metaworld/{task}" for task in METAWORLD_TASKS),
    *(f"maniskill/{task}" for task in MANISKILL_TASKS),
)
BAR_ALL, BAR_MEAN, BAR_EPISODES, BAR_SEED = 0.92, 0.80, 100, 5000
"""A policy meets the bar with these rates, on at least so many episodes from this seed on."""
TRIED = "tried.json"


@dataclass(frozen=True)
class ReportConfig:
    """Writes RESULTS.md with tables and pictures of all policies that were evaluated."""

    folder: Path = Path("checkpoints")
    """Where the policy folders are, at any depth."""
    out: Path | None = None
    """The file to write; FOLDER/RESULTS.md if not given. Pictures go to results/ beside it."""
    json: str | None = None
    """Where to write what was written, and the table of the bar; - is standard output."""


def run_report(config: ReportConfig) -> dict[str, Any]:
    """``madviz report``. Raises UserError for a folder without evaluated policies, and for files
    that contradict each other."""
    evidence = find_evidence(config.folder)
    if not evidence:
        raise UserError(
            f"expected policy folders with evaluation.json in {config.folder}, found none; "
            "run `madviz eval --policy NAME --card`"
        )
    out = config.out or config.folder / "RESULTS.md"
    pictures = out.parent / "results"
    tables = [table for layout in LAYOUTS for table in build(layout, evidence)]
    verdicts = [judge(task, evidence) for task in TWENTY]
    drawn = {f"{t.layout.key}-{t.suite}.svg": picture(t) for t in tables}
    remake = f"madviz report --folder {shlex.quote(config.folder.as_posix())}"
    if config.out is not None:
        remake += f" --out {shlex.quote(out.as_posix())}"
    text = _page(remake, evidence, verdicts, tables, tried(config.folder))
    pictures.mkdir(parents=True, exist_ok=True)
    for old in set(pictures.glob("*.svg")) - {pictures / name for name in drawn}:
        old.unlink()  # Of a table that is no longer there.
    for name, drawing in drawn.items():
        write_bytes(pictures / name, drawing.encode())
    write_bytes(out, text.encode())
    return {
        "schema": 1,
        "path": str(out),
        "pictures": [str(pictures / name) for name in drawn],
        "policies": len(evidence),
        "tables": [f"{table.layout.key}-{table.suite}" for table in tables],
        "bar": [_verdict_json(each) for each in verdicts],
    }


# --- The bar --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """How a task's policy stands to the bar."""

    task: str
    row: Row | None
    """None where no policy was trained and measured."""
    mean: Rate | None
    reasons: tuple[str, ...]
    """What it falls short of; none: the bar is met."""

    @property
    def words(self) -> str:
        if self.row is None:
            return "not trained"
        return "met" if not self.reasons else f"not met: {'; '.join(self.reasons)}"


def judged_on(task: str) -> tuple[str, ...]:
    """The subsets of the mean; PokeCube's first person alone cannot see enough (paper)."""
    return tuple(c for c in THREE if task != "maniskill/poke-cube" or c != "first")


def judge(task: str, evidence: Sequence[Evidence]) -> Verdict:
    """The task's MAD policy on three cameras; of several, the one with the highest mean."""
    found = []
    for each in usual_alphas(evidence):
        if (each.task, each.method, each.setting, each.merge) == (task, "mad", "three", "sum"):
            row = Row(each.name, evidence=[each])
            for column in THREE:
                if outcomes := each.of(column):
                    row.cells[column] = {(task, each.seed, s): ok for s, ok in outcomes.items()}
            if mean := row.mean(judged_on(task)):
                found.append((mean.value, row))
    if not found:
        return Verdict(task, None, None, ())
    row = max(found, key=lambda each: each[0])[1]
    mean = row.mean(judged_on(task))
    return Verdict(task, row, mean, tuple(_reasons(task, row, mean)))


def _reasons(task: str, row: Row, mean: Rate | None) -> list[str]:
    reasons = []
    missing = [c for c in judged_on(task) if c not in row.cells]
    if missing:
        reasons.append(f"{', '.join(missing)} not measured")
    whole = row.rate("all")
    if whole is not None and whole.value < BAR_ALL:
        reasons.append(f"all {whole.value:.2f} is below {BAR_ALL}")
    if mean is not None and mean.value < BAR_MEAN:
        reasons.append(f"mean {mean.value:.2f} is below {BAR_MEAN:.2f}")
    if mean is not None and mean.n < BAR_EPISODES:
        reasons.append(f"{mean.n} episodes, {BAR_EPISODES} are needed")
    if row.evidence[0].first_seed < BAR_SEED:
        reasons.append(f"seeds below {BAR_SEED}")
    return reasons


def tried(folder: Path) -> dict[str, list[str]]:
    """What was tried, in the order of the twenty tasks; empty without the file. Raises UserError
    for a file of another form."""
    path = folder / TRIED
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise UserError(f"expected JSON in {path}: {error}") from error
    form = isinstance(found, dict) and set(found) <= set(TWENTY) and all(
        isinstance(lines, list) and all(isinstance(line, str) for line in lines)
        for lines in found.values()
    )  # fmt: skip
    if not form:
        raise UserError(
            f'expected {path} to hold a list of sentences for each task, such as {{"{TWENTY[0]}": '
            '["12 rounds: all 0.90"]}; see the tasks with `madviz list`'
        )
    return {task: found[task] for task in TWENTY if found.get(task)}


def _verdict_json(verdict: Verdict) -> dict[str, Any]:
    subsets = {} if verdict.row is None else {c: verdict.row.rate(c) for c in THREE}
    rated = {**subsets, "mean": verdict.mean}
    return {
        "task": verdict.task,
        "policy": None if verdict.row is None else str(verdict.row.evidence[0].path),
        "verdict": verdict.words,
        **{
            name: {"success": rate.value, "n": rate.n, "ci95": list(rate.interval)}
            for name, rate in rated.items()
            if rate is not None
        },
    }


# --- The page -------------------------------------------------------------------------------


def _without_weights(evidence: Sequence[Evidence]) -> list[str]:
    """Says which policies are here as figures only."""
    bare = [e.folder for e in evidence if not (e.path / WEIGHTS).is_file()]
    if not bare:
        return []
    named = ", ".join(f"`{name}`" for name in bare)
    return [
        f"Here as figures only, without weights: {named}. They serve a comparison, or fall "
        f"short by too much to be shown at work; the commands "
        "under its table make them again."
    ]


def _page(
    remake: str,
    evidence: Sequence[Evidence],
    verdicts: Sequence[Verdict],
    tables: Sequence[Table],
    attempts: dict[str, list[str]],
) -> str:
    sections = [
        "# Results",
        f"Generated by `{remake}` from `config.json` and `evaluation.json` of {len(evidence)} "
        "policies; not edited. Success counts at the last step of an episode. Every number has its "
        "95% interval in brackets and its count of episodes n, of each subset where it is a mean; "
        "rates have Wilson's interval. Intervals are about episodes: they do not say how another "
        "training or another task would come out. A dash is what was not measured or cannot be. "
        f"The commands under a table train and evaluate its policies again, in `{AGAIN}/`; what "
        "ships with weights is evaluated as it is by the command in its card.",
        *_without_weights(evidence),
        _bar_section(verdicts, attempts),
        *(_section(table) for table in tables),
    ]
    return "\n\n".join(sections) + "\n"


def _bar_section(verdicts: Sequence[Verdict], attempts: dict[str, list[str]]) -> str:
    met = sum(verdict.words == "met" for verdict in verdicts)
    missing = sum(verdict.row is None for verdict in verdicts)
    lines = [
        "## Twenty tasks and the bar",
        "",
        f"The bar: `all` at least {BAR_ALL}, and at least {BAR_MEAN:.2f} on the mean of "
        f"{', '.join(THREE)} (PokeCube: {', '.join(judged_on('maniskill/poke-cube'))}), with "
        f"{BAR_EPISODES} episodes of each from seed {BAR_SEED} on. {met} of {len(verdicts)} tasks "
        f"meet it, {len(verdicts) - met - missing} do not, {missing} have no policy yet.",
        "",
        *_head(("task", "policy", *THREE, "mean", "bar")),
    ]
    for verdict in verdicts:
        row = verdict.row
        cells = [_cell(None if row is None else row.rate(column)) for column in THREE]
        name = "–" if row is None else f"`{row.evidence[0].folder}`"
        lines.append(_line((verdict.task, name, *cells, _cell(verdict.mean), verdict.words)))
    for suite in dict.fromkeys(task.split("/")[0] for task in TWENTY):
        whole = _whole(suite, verdicts)
        cells = [_cell(whole.rate(column)) for column in THREE]
        label = f"average of {len(whole.tasks)} in {suite}"
        if len(whole.tasks) > 1:
            lines.append(_line((label, "", *cells, _cell(whole.mean(THREE)), "")))
    if attempts:
        lines += ["", f"What was tried on the way (`{TRIED}`; weights were not kept):", ""]
        lines += [f"- {task}: {line}" for task, tries in attempts.items() for line in tries]
    used = [e for verdict in verdicts if verdict.row for e in verdict.row.evidence]
    return "\n".join([*lines, "", _commands(used)])


def _whole(suite: str, verdicts: Sequence[Verdict]) -> Row:
    """All of a suite's policies in one row."""
    whole = Row(suite)
    for verdict in verdicts:
        if verdict.row is not None and verdict.task.startswith(f"{suite}/"):
            for column, cell in verdict.row.cells.items():
                whole.cells.setdefault(column, {}).update(cell)
    return whole


def _section(table: Table) -> str:
    layout, mean_of = table.layout, table.mean_of
    headings = ("task", "method", "trainings", *table.columns, *(["mean"] if mean_of else []))
    lines = [f"## {layout.title}: {table.suite}", "", *_head(headings)]
    for task, row in table.rows:
        lines.append(_row_line(task, row, table))
    if len({task for task, _ in table.rows}) > 1:
        for row in table.averages:
            lines.append(_row_line(f"average of {len(row.tasks)}", row, table))
    image = f"results/{layout.key}-{table.suite}.svg"
    lines += ["", f"![{layout.title}, {table.suite}]({image})", ""]
    lines += [f"- {sentence}" for sentence in claims(table)]
    used = [e for row in table.averages for e in row.evidence]
    return "\n".join([*lines, "", _commands(used)])


def _row_line(task: str, row: Row, table: Table) -> str:
    cells = [_cell(row.rate(column)) for column in table.columns]
    mean = [_cell(row.mean(table.mean_of))] if table.mean_of else []
    if mean and row.measured(table.mean_of) != list(table.mean_of):
        mean = [f"{mean[0]} ({', '.join(row.measured(table.mean_of))})"]
    return _line((task, row.label, str(row.trainings), *cells, *mean))


def _cell(rate: Rate | None) -> str:
    if rate is None:
        return "–"
    return in_words(rate.value, rate.interval, rate.n)


def _head(headings: Sequence[str]) -> list[str]:
    return [_line(headings), "|" + "---|" * len(headings)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _commands(evidence: Sequence[Evidence]) -> str:
    """How to make a table again: trainings, their evaluations, the report of both."""
    unique = {each.path: each for each in evidence}
    lines = []
    for each in unique.values():
        folder = shlex.quote(f"{AGAIN}/{each.folder}")
        if each.command:
            lines.append(train_again(each.command, each.folder))
        lines.append(
            f"madviz eval --policy {folder} --subsets {' '.join(each.outcomes)} "
            f"--episodes {each.episodes} --seed {each.first_seed} --card"
        )
    block = "\n".join(f"    {line}" for line in [*lines, f"madviz report --folder {AGAIN}"])
    return (
        f"<details><summary>Made again by {len(lines) + 1} commands</summary>\n\n{block}\n\n"
        "</details>"
    )


def picture(table: Table) -> str:
    """The table's averages as bars with their intervals, SVG."""
    groups = (*table.columns, *(["mean"] if table.mean_of else []))
    series = {}
    for row in table.averages:
        rates = [row.rate(column) for column in table.columns]
        rates += [row.mean(table.mean_of)] if table.mean_of else []
        label = f"{row.label} ({len(row.tasks)} task{'s' * (len(row.tasks) != 1)})"
        series[label] = [None if r is None else svg.Bar(r.value, *r.interval) for r in rates]
    return svg.bars(f"{table.layout.title}: {table.suite}", groups, series)


def report_words(result: dict[str, Any]) -> str:
    """What was written, as lines."""
    met = sum(each["verdict"] == "met" for each in result["bar"])
    return (
        f"{result['path']}: {result['policies']} policies, {len(result['tables'])} tables, "
        f"{len(result['pictures'])} pictures; {met} of {len(result['bar'])} tasks meet the bar"
    )
