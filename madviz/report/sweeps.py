"""The sweep file of a table: one ``madviz sweep`` trains and evaluates its policies again.

The grids are made from the commands that trained the policies, so that nothing is typed. Policies
with the same options share a grid.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from madviz.measure.evidence import Evidence
from madviz.policies.again import words_again

FIRST_LINE = "# Written by `madviz report`. Trains and evaluates the policies of a table again:"
AXES = ("task", "method", "setting", "recipe", "seed")
Options = tuple[tuple[str, str], ...]


def sweep_text(file: str, evidence: Sequence[Evidence]) -> str:
    """TOML for ``madviz sweep``; ``file`` is where it will be."""
    entries = list(dict.fromkeys(_entry(policy) for policy in evidence if policy.command))
    varied = _varied(entries)
    grids: dict[tuple[tuple[str, ...], Options], list[tuple[str, str]]] = {}
    for axes, options in entries:
        kept = tuple((k, f"[{v}]" if (axes, k) in varied else v) for k, v in options)
        grids.setdefault((axes[2:], kept), []).append((axes[0], axes[1]))
    lines = [FIRST_LINE, "#", f"#     madviz sweep {file}", ""]
    for ((setting, recipe, seed), options), pairs in grids.items():
        for tasks, methods in _rectangles(pairs):
            lines += [
                "[[grid]]",
                f"tasks = {json.dumps(tasks)}",
                f"methods = {json.dumps(methods)}",
                f'settings = ["{setting}"]',
                f'recipes = ["{recipe}"]',
                f"seeds = [{seed}]",
            ]
            lines += ["[grid.train]", *(f"{k} = {v}" for k, v in options)] if options else []
            lines.append("")
    episodes = max(policy.episodes for policy in evidence)
    first = max(policy.first_seed for policy in evidence)
    return "\n".join([*lines, "[eval]", f"episodes = {episodes}", f"seed = {first}"]) + "\n"


def is_sweep_of_a_table(file: Path) -> bool:
    """Whether ``sweep_text`` made it."""
    return (
        file.suffix == ".toml"
        and file.is_file()
        and file.read_bytes().startswith(FIRST_LINE.encode())
    )


def _entry(evidence: Evidence) -> tuple[tuple[str, ...], Options]:
    """Task, method, setting, recipe and seed of a training; its other options as TOML."""
    words = words_again(evidence.config.training)
    named: dict[str, list[str]] = {}
    for word in words[words.index("train") + 1 :]:
        if word.startswith("--"):
            named[word[2:]] = []
        else:
            named[list(named)[-1]].append(word)
    for own in AXES:
        named.pop(own, None)
    axes = (
        evidence.config.task,
        evidence.config.method,
        evidence.config.setting,
        evidence.config.recipe,
        str(evidence.seed),
    )
    options = [_option(name, values) for name, values in named.items()]
    return axes, tuple(sorted(options))


def _option(name: str, values: Sequence[str]) -> tuple[str, str]:
    if not values:
        head, dot, tail = name.rpartition(".")
        negated = tail.startswith("no-")
        return f"{head}{dot}{tail.removeprefix('no-')}", "false" if negated else "true"
    try:
        float(values[0])
        return name, values[0]
    except ValueError:
        return name, json.dumps(values[0])


def _varied(entries: Sequence[tuple[tuple[str, ...], Options]]) -> set[tuple[tuple[str, ...], str]]:
    """Trainings that differ in options alone, with those options: in a list, an option is part of a
    run's name."""
    return {
        (axes, name)
        for axes, options in entries
        for others_axes, others in entries
        if others_axes == axes
        for name, _ in set(options) ^ set(others)
    }


def _rectangles(pairs: Sequence[tuple[str, str]]) -> list[tuple[list[str], list[str]]]:
    """(task, method) pairs as lists of tasks by lists of methods."""
    methods: dict[str, list[str]] = {}
    for task, name in pairs:
        methods.setdefault(task, []).append(name)
    tasks: dict[tuple[str, ...], list[str]] = {}
    for task, names in methods.items():
        tasks.setdefault(tuple(sorted(names)), []).append(task)
    return [(alike, list(names)) for names, alike in tasks.items()]
