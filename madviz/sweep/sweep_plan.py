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
says everything that varies, so that it stays the same whatever else is added to the file. A grid
whose options have one value each may say ``name = "wide"``: its runs are named
``metaworld-hammer-mad-light-wide-seed1``. Every unknown word, task or method is an error before
anything runs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import msgspec

from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import method
from madviz.envs.custom import is_own
from madviz.envs.registry import check_task, setting
from madviz.errors import UserError, unknown
from madviz.subsets import camera_of, groups, mask_of
from madviz.sweep.run import Run
from madviz.system.files import read_toml
from madviz.system.options import options as options_of
from madviz.system.options import words_for
from madviz.system.typed import typed
from madviz.training.config import TrainConfig, recipe_of

FIX = "fix the sweep file"
Names = Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
SeedNumber = Annotated[int, msgspec.Meta(ge=0)]
Table = dict[str, Any]
"""A TOML table whose words are another command's options."""


class Grid(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A table ``[grid]``: every combination of these is a run."""

    tasks: Names
    methods: Names
    settings: Names = ("three",)
    recipes: Names = ("light",)
    seeds: Annotated[tuple[SeedNumber, ...], msgspec.Meta(min_length=1)] = (1,)
    """The seeds of training."""
    train: Table = {}
    """More options of ``madviz train``; a list is one more axis."""
    name: str = ""
    """A word in the names of runs whose options have one value each."""


class EvalOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, omit_defaults=True):
    """The table ``[eval]``: options of ``madviz eval``."""

    episodes: Annotated[int, msgspec.Meta(ge=1)] | None = None
    seed: SeedNumber | None = None
    subsets: Annotated[list[str], msgspec.Meta(min_length=1)] | None = None


class SweepFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The whole file."""

    grid: Grid | Annotated[list[Grid], msgspec.Meta(min_length=1)]
    eval: EvalOptions = EvalOptions()


def read_plan(file: str | Path) -> tuple[Run, ...]:
    """The runs that a sweep file asks for. Raises UserError for a file that is missing, not TOML,
    or asks for what does not exist."""
    path = Path(file)
    document = read_toml(path, "a sweep file", FIX)
    asked = typed(document, SweepFile, path, FIX)
    evaluation = tuple(words_for(msgspec.to_builtins(asked.eval)))
    runs: dict[str, Run] = {}
    for grid in asked.grid if isinstance(asked.grid, list) else [asked.grid]:
        expanded = _expand(path, grid, evaluation)
        _check_subsets(path, grid, asked.eval.subsets or ())
        for run in expanded:
            if runs.setdefault(run.name, run) != run:
                raise UserError(
                    f"{path}: expected one set of options for {run.name}, found two in different "
                    "grids; put the values that differ in a list, so that names say them"
                )
    return tuple(runs.values())


def _expand(path: Path, grid: Grid, evaluation: tuple[str, ...]) -> list[Run]:
    options = flat(grid.train)
    reserved = {"task", "method", "setting", "recipe", "seed", "out", "resume"} & options.keys()
    if reserved:
        raise UserError(
            f"{path}: expected other options in [grid.train], found {', '.join(sorted(reserved))}; "
            "tasks, methods, settings, recipes and seeds are lists in [grid], folders are ours"
        )
    _check(grid)
    _check_options(path, options, grid.recipes)
    varied = {key: value for key, value in options.items() if isinstance(value, list)}
    for key, values in varied.items():
        if not values:
            raise UserError(f"{path}: expected values for {key}, found none; leave it out")
    if grid.name and varied:
        raise UserError(
            f"{path}: expected one value for each option of the grid named {grid.name!r}, found a "
            f"list for {', '.join(varied)}; leave its name out, or write a grid for each value"
        )
    axes = product(grid.tasks, grid.methods, grid.settings, grid.recipes, grid.seeds)
    runs = []
    for task, name, where, recipe, seed in axes:
        mine = {key: value for key, value in options.items() if recipe_of(key) in (None, recipe)}
        axes_here = {key: values for key, values in varied.items() if key in mine}
        for values in product(*axes_here.values()):
            chosen = dict(zip(axes_here, values, strict=True))
            train = ["--task", task, "--method", name, "--setting", where, "--recipe", recipe]
            train += ["--seed", str(seed), *words_for({**mine, **chosen})]
            words = [f"{key.split('.')[-1]}{value}" for key, value in chosen.items()]
            words += [grid.name] if grid.name else []
            label = _name(task, name, where, recipe, words, seed)
            runs.append(Run(label, tuple(train), evaluation))
    return runs


def _check_options(path: Path, asked: Table, recipes: Sequence[str]) -> None:
    """Raises UserError for an option that ``madviz train`` does not have, or that none of
    ``recipes`` uses."""
    named = [name for name, *_ in options_of(TrainConfig)]
    known = [name.removeprefix("--") for name in [*named, *TrainConfig.renamed_options()]]
    for key in asked:
        recipe = recipe_of(key)
        if recipe is not None and recipe not in recipes:
            raise UserError(
                f"{path}: expected {key} in a grid with the recipe {recipe}, found "
                f"{', '.join(recipes)}; leave it out"
            )
        if key not in known and not key.startswith("own."):
            raise UserError(f"{path}: {unknown('option of madviz train', key, known)}")


def _check(grid: Grid) -> None:
    for task in grid.tasks:
        check_task(task)
    for name in grid.methods:
        for recipe in grid.recipes:
            if recipe not in method(name).recipes:
                raise UserError(
                    f"method {name!r} has the recipes {', '.join(method(name).recipes)}, "
                    f"not {recipe!r}"
                )
        for where in grid.settings:
            method(name).rows(setting(where).streams)


def _check_subsets(path: Path, grid: Grid, subsets: Sequence[str]) -> None:
    """Raises UserError for one of ``subsets`` that a policy of ``grid`` could not act on."""
    options = flat(grid.train)
    if "cameras" in options or any(map(is_own, grid.tasks)):
        return  # Only madviz's own cameras are known here.
    merges, cameras = (_values(options.get(key, "")) for key in ("merge", "camera"))
    for name, where, merge, camera in product(grid.methods, grid.settings, merges, cameras):
        chosen = method(name)
        place = setting(where)
        support = MERGES[chosen.merge_for(place.streams, merge)].support
        alone = chosen.one_camera and (camera or place.cameras[0])
        streams = tuple(s for s in place.streams if not alone or camera_of(s) == alone)
        for subset in subsets:
            mask_of(subset, place.streams)  # Refuses a name that no policy knows.
            known = {*subset.split("+")} <= groups(streams).keys()
            if not (known and support.allows(mask_of(subset, streams))):
                words = support.words if known else ", ".join(groups(streams))
                raise UserError(
                    f"{path}: expected subsets that {name} can act on ({words}), found {subset!r}; "
                    f"leave it out of [eval], or give {name} a sweep file of its own"
                )


def _values(asked: Any) -> list[Any]:
    return asked if isinstance(asked, list) else [asked]


def flat(table: Table, prefix: str = "") -> Table:
    """``{"light": {"rounds": 3}}`` -> ``{"light.rounds": 3}``, as the command line spells it."""
    options: Table = {}
    for key, value in table.items():
        name = f"{prefix}{key}".replace("_", "-")
        options |= flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return options


def _name(task: str, name: str, where: str, recipe: str, words: list[str], seed: int) -> str:
    parts = [task.replace("/", "-"), name]
    parts += [] if where == "three" else [where]
    return re.sub(r"[^\w.+-]", "_", "-".join([*parts, recipe, *words, f"seed{seed}"]))
