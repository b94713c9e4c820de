"""From one small file to a list of runs: methods x tasks x settings x seeds, each with a name.

    [[grid]]                              # one or several; their runs are put together
    tasks = ["metaworld/hammer", "metaworld/push"]
    methods = ["mad", "merged-only"]
    seeds = [1, 2]                        # of training; [1] where left out
    settings = ["three"]                  # likewise ["three"]
    recipes = ["light"]                   # and ["light"]

    [grid.train]                          # more options of `madviz train`
    light.rounds = 20
    light.alpha = [0.2, 0.5, 0.8]         # a list is one more axis

    [eval]                                # options of `madviz eval`
    episodes = 100
    seed = 5000
    subsets = ["all", "first"]            # left out: what says most about each policy

is 2 x 2 x 2 x 3 = 24 runs, named ``metaworld-hammer-mad-light-alpha0.2-seed1`` and so on. A name
says everything that varies, so that it stays the same whatever else is added to the file. Every
unknown word, task or method is an error before anything runs.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from madviz.agent.methods import method
from madviz.envs.registry import check_task, setting
from madviz.errors import UserError, unknown
from madviz.sweep.run import Run

AXES = {
    **{"tasks": None, "methods": None, "settings": ["three"]},
    **{"recipes": ["light"], "seeds": [1]},
}
"""Axis -> its values where the file has none; None is an axis every grid must have."""
EVAL = {"episodes": int, "seed": int, "subsets": list}


@dataclass(frozen=True)
class Plan:
    """What a sweep file asks for."""

    name: str
    """The file's name without its ending; the default folder is runs/NAME."""
    runs: tuple[Run, ...]


def read_plan(file: str | Path) -> Plan:
    """Raises UserError for a file that is missing, not TOML, or asks for what does not exist."""
    path = Path(file)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: expected a sweep file, found: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: expected TOML, found: {error}") from error
    _known(path, "table", document, {"grid": 0, "eval": 0})
    grids = document.get("grid", [])
    grids = [grids] if isinstance(grids, dict) else grids
    if not isinstance(grids, list) or not grids:
        raise UserError(f"{path}: expected a table [grid] with tasks and methods, found none")
    evaluation = _evaluation(path, document.get("eval", {}))
    runs: dict[str, Run] = {}
    for grid in grids:
        for run in _expand(path, grid, evaluation):
            if runs.setdefault(run.name, run) != run:
                raise UserError(
                    f"{path}: expected one set of options for {run.name}, found two in different "
                    "grids; let a list of values tell them apart"
                )
    return Plan(path.stem, tuple(runs.values()))


def _expand(path: Path, grid: Any, evaluation: tuple[str, ...]) -> list[Run]:
    if not isinstance(grid, dict):
        raise UserError(f"{path}: expected [grid] to be a table, found {grid!r:.60}")
    _known(path, "word in [grid]", grid, {**AXES, "train": 0})
    axes = {axis: _values(path, axis, grid.get(axis, default)) for axis, default in AXES.items()}
    options = flat(grid.get("train", {}))
    reserved = {"task", "method", "setting", "recipe", "seed", "out", "resume"} & options.keys()
    if reserved:
        raise UserError(
            f"{path}: expected other options in [grid.train], found {', '.join(sorted(reserved))}; "
            "tasks, methods, settings, recipes and seeds are lists in [grid], folders are ours"
        )
    _check(axes)
    varied = {key: value for key, value in options.items() if isinstance(value, list)}
    runs = []
    for task, name, where, recipe, seed in product(*axes.values()):
        for values in product(*varied.values()):
            chosen = dict(zip(varied, values, strict=True))
            words = ["--task", task, "--method", name, "--setting", where, "--recipe", recipe]
            words += ["--seed", str(seed), *_options({**options, **chosen})]
            label = _name(task, name, where, recipe, chosen, seed)
            runs.append(Run(label, tuple(words), evaluation))
    return runs


def _check(axes: dict[str, list[Any]]) -> None:
    for task in axes["tasks"]:
        check_task(task)
    for name in axes["methods"]:
        for recipe in axes["recipes"]:
            if recipe not in method(name).recipes:
                raise UserError(
                    f"method {name!r} has the recipes {', '.join(method(name).recipes)}, "
                    f"not {recipe!r}"
                )
        for where in axes["settings"]:
            method(name).rows(setting(where).streams)


def _values(path: Path, axis: str, found: Any) -> list[Any]:
    kind = int if axis == "seeds" else str
    if not isinstance(found, list) or not found or not all(type(v) is kind for v in found):
        words = "whole numbers" if kind is int else "names"
        raise UserError(f"{path}: expected {axis} to be a list of {words}, found {found!r:.60}")
    return found


def _evaluation(path: Path, table: Any) -> tuple[str, ...]:
    if not isinstance(table, dict):
        raise UserError(f"{path}: expected [eval] to be a table, found {table!r:.60}")
    _known(path, "word in [eval]", table, EVAL)
    for key, value in table.items():
        if type(value) is not EVAL[key]:
            raise UserError(
                f"{path}: expected {key} in [eval] to be "
                f"{'a list of names' if EVAL[key] is list else 'a whole number'}, found {value!r}"
            )
    return tuple(_options(table))


def flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"light": {"rounds": 3}}`` -> ``{"light.rounds": 3}``, as the command line spells it."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}".replace("_", "-")
        found |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return found


def _options(options: dict[str, Any]) -> list[str]:
    """``{"a": 1, "b": True, "c": False, "d": ["x", "y"]}`` -> ``--a 1 --b --no-c --d x y``."""
    words: list[str] = []
    for key, value in options.items():
        if isinstance(value, bool):
            head, dot, tail = key.rpartition(".")
            words.append(f"--{key}" if value else f"--{head}{dot}no-{tail}")
        else:
            several = value if isinstance(value, list) else [value]
            words += [f"--{key}", *map(str, several)]
    return words


def _name(task: str, name: str, where: str, recipe: str, chosen: dict[str, Any], seed: int) -> str:
    parts = [task.replace("/", "-"), name, *([] if where == "three" else [where]), recipe]
    parts += [f"{key.split('.')[-1]}{value}" for key, value in chosen.items()]
    return re.sub(r"[^\w.+-]", "_", "-".join([*parts, f"seed{seed}"]))


def _known(path: Path, kind: str, table: dict[str, Any], known: dict[str, Any]) -> None:
    for key in table:
        if key not in known:
            raise UserError(f"{path}: {unknown(kind, key, list(known))}")
