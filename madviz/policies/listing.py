"""``madviz list``: tasks, settings, methods, merges, and every policy that can be found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import METHODS
from madviz.envs.registry import SETTINGS, known_tasks
from madviz.errors import UserError
from madviz.policies import checkpoint
from madviz.policies.config import PolicyConfig, read_config
from madviz.policies.measured import EvaluationFile, RateRow, as_evaluation, seeds_of
from madviz.system.files import read_json

NO_POLICY = "policies: none found"


@dataclass(frozen=True)
class ListConfig:
    """Lists tasks, settings, methods and the policies that were found."""

    json: str | None = None
    """Write the list to this file; ``-`` is standard output, and then nothing else goes there."""
    all: bool = False
    """Also list policies without weights, of which only success rates are here."""


class PolicyRow(TypedDict):
    """One policy of the list."""

    name: str
    path: str
    task: str
    method: str
    setting: str
    recipe: str
    definition: str
    merge: str
    camera: str
    trained_subsets: list[str]
    digest: str
    success: dict[str, RateRow]
    """By subset; empty where it was not evaluated."""
    seeds: str
    """The use of its episodes' seeds, ``reporting`` or another use; '' as above."""
    weights: bool
    """Whether it can act; else only what was measured is here."""


class BrokenRow(TypedDict):
    """A folder that holds no policy that could be read."""

    name: str
    path: str
    error: str


class MethodRow(TypedDict):
    """One training method."""

    recipes: list[str]
    needs: list[str]
    summary: str
    merge: str
    supports: str


class MergeRow(TypedDict):
    """One way to make a feature of the present streams."""

    supports: str


class Catalogue(TypedDict):
    """The document that ``madviz list --json`` writes."""

    schema: int
    tasks: list[str]
    settings: list[str]
    methods: dict[str, MethodRow]
    merges: dict[str, MergeRow]
    policies: list[PolicyRow]
    """Those that can act."""
    without_weights: list[PolicyRow]
    """Those of which only what was measured is here."""
    broken: list[BrokenRow]
    all: bool
    """Whether the text names ``without_weights``."""


def list_policies() -> tuple[list[PolicyRow], list[BrokenRow]]:
    """Every policy that can act, with its shipped success; and those that are broken, why."""
    return _listed(checkpoint.policy_folders(), _acting_row)


def list_measured() -> tuple[list[PolicyRow], list[BrokenRow]]:
    """Policies without weights, as they were measured; and those that are broken, why."""
    return _listed(checkpoint.measured_folders(), _measured_row)


def _listed(
    folders: Mapping[str, Path], row: Callable[[str, Path], PolicyRow]
) -> tuple[list[PolicyRow], list[BrokenRow]]:
    rows: list[PolicyRow] = []
    broken: list[BrokenRow] = []
    for name, path in folders.items():
        try:
            rows.append(row(name, path))
        except UserError as error:
            broken.append({"name": name, "path": str(path), "error": str(error)})
    return rows, broken


def _acting_row(name: str, path: Path) -> PolicyRow:
    folder = checkpoint.describe(path)
    shipped = checkpoint.shipped_evaluation(path)
    return _row(name, path, folder.config, folder.spec.digest, shipped, True)


def _measured_row(name: str, path: Path) -> PolicyRow:
    config, _ = read_config(path / checkpoint.CONFIG)
    file = path / checkpoint.EVALUATION
    measured = as_evaluation(read_json(file), file)
    return _row(name, path, config, measured["digest"], measured, False)


def run_list(config: ListConfig) -> Catalogue:
    """The document that ``madviz list --json`` writes; a method ``supports`` what its own merge
    does."""
    policies, broken = list_policies()
    measured, broken_too = list_measured()
    methods: dict[str, MethodRow] = {}
    for name, method in METHODS.items():
        methods[name] = {
            "recipes": list(method.recipes),
            "needs": list(method.needs.words),
            "summary": method.summary,
            "merge": method.merge,
            "supports": MERGES[method.merge].support.words,
        }
    return {
        "schema": 1,
        "tasks": list(known_tasks()),
        "settings": list(SETTINGS),
        "methods": methods,
        "merges": {name: {"supports": merge.support.words} for name, merge in MERGES.items()},
        "policies": policies,
        "without_weights": measured,
        "broken": [*broken, *broken_too],
        "all": config.all,
    }


def _row(
    name: str,
    path: Path,
    config: PolicyConfig,
    digest: str,
    measured: EvaluationFile | None,
    weights: bool,
) -> PolicyRow:
    success: dict[str, RateRow] = {}
    for subset, row in measured["subsets"].items() if measured else ():
        success[subset] = {"success": row["success"], "n": row["n"], "ci95": row["ci95"]}
    return {
        "name": name,
        "path": str(path),
        "task": config.task,
        "method": config.method,
        "setting": config.setting,
        "recipe": config.recipe,
        "definition": config.definition,
        "merge": config.merge,
        "camera": config.camera,
        "trained_subsets": list(config.trained_subsets),
        "digest": digest,
        "success": success,
        "seeds": seeds_of(measured) if measured else "",
        "weights": weights,
    }


def catalogue(listed: Catalogue) -> str:
    """The list as lines; a policy's line carries its success with all its cameras, if it was
    measured."""
    lines = ["tasks:", *_by_suite(listed["tasks"]), "settings, and what a policy sees in them:"]
    lines += [f"  {name:17} {', '.join(SETTINGS[name].streams)}" for name in listed["settings"]]
    lines.append("methods:")
    lines += [f"  {name:17} {method['summary']}" for name, method in listed["methods"].items()]
    policies = listed["policies"]
    bare = listed["without_weights"]
    lines.append("policies, and their success with all their cameras:" if policies else NO_POLICY)
    lines += [_policy_line(policy) for policy in policies]
    if listed["all"]:
        lines.append("without weights, success rates only:")
        lines += [_policy_line(policy) for policy in bare]
    elif bare:
        lines.append(f"{len(bare)} more have no weights here: `madviz list --all`")
    lines += [f"  {row['name']:45} broken: {row['error']}" for row in listed["broken"]]
    return "\n".join(lines)


def _by_suite(tasks: Sequence[str]) -> list[str]:
    suites: dict[str, list[str]] = {}
    for task in tasks:
        suites.setdefault(task.partition("/")[0], []).append(task)
    return [f"  {', '.join(names)}" for names in suites.values()]


def _policy_line(policy: PolicyRow) -> str:
    """Single Camera's whole view is its one camera, which the line names in place of ``all``."""
    whole = policy["success"].get("all")
    if whole is None:
        return f"  {policy['name']:45} not evaluated"
    low, high = whole["ci95"]
    return (
        f"  {policy['name']:45} {policy['camera'] or 'all':8} {whole['success']:.2f} "
        f"[{low:.2f}, {high:.2f}] n={whole['n']}, {policy['seeds']} seeds"
    )
