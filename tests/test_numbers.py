"""Every number of every command has a range, and what is outside is refused in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, get_args, get_origin

import pytest

from benchmarks.__main__ import BENCHMARKS, main
from madviz import cli
from madviz.commands import Command
from madviz.errors import UserError
from madviz.system.numbers import Range, check_numbers
from madviz.system.options import bare, notes, options
from madviz.system.plugins import load
from madviz.training.config import TrainConfig, recipe_of
from madviz.training.light import LightConfig
from madviz.training.train import train
from tests.mistakes import refused

ODD = {"-1": -1.0, "0": 0.0, "nan": float("nan"), "inf": float("inf"), "1" + 30 * "0": 1e30}

ROWS = [
    *((name, command, cli.main) for name, command in cli.COMMANDS.items()),
    *((name, command, main) for name, command in BENCHMARKS.items()),
]
"""Name, command and the program's ``main``."""


def ranges(config: type) -> Iterator[tuple[str, type, Range | None]]:
    """Every number that ``config``, a dataclass, has: option, int or float, range."""
    for option, kind, _ in options(config):
        choices = (kind,) if get_origin(kind) is Annotated else (kind, *get_args(kind))
        for choice in choices:
            if bare(choice) in (int, float):
                yield option, bare(choice), next(notes(choice, Range), None)


@pytest.mark.parametrize(("name", "command", "program"), ROWS)
def test_every_number_is_refused_outside_its_range(
    name: str,
    command: Command,
    program: Callable[[Sequence[str]], int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = load(command.config)
    for option, kind, allowed in ranges(config):
        assert allowed is not None, f"{name} {option}: an option without a range"
        assert allowed.kind is kind
        wanted = "a whole number" if kind is int else "a number"
        outside = [text for text, value in ODD.items() if not allowed.holds(value)]
        for text in outside:
            with pytest.raises(ValueError, match=f"^expected {wanted} .*, found {text}$"):
                allowed.instance_from_str([text])
        for words in ([option, outside[0]], [f"{option}={outside[-1]}"]):
            found = f"{allowed.high}, found {words[-1].removeprefix(f'{option}=')}"
            recipe = recipe_of(option.removeprefix("--")) if name == "train" else None
            chosen = ["--recipe", recipe] if recipe else []
            line = refused([name, *needed(command), *chosen, *words], found, capsys, program)
            assert line.startswith(f"madviz: {option}: expected {wanted} ")


def needed(command: Command) -> list[str]:
    """Words for the options without a default: those that are given by their place, and others."""
    config = load(command.config)
    names = [f.name for f in fields(config) if f.default is f.default_factory is MISSING]
    return [
        word for name in names for word in (["x"] if command.positional else [f"--{name}", "x"])
    ]


def test_every_value_of_an_option_counts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["crowd", "--visitors", "1", "0", "4"]
    wanted = "--visitors: expected a whole number from 1 to 1000000, found 0"
    refused(words, wanted, capsys, main)


@pytest.mark.parametrize(("name", "command", "program"), ROWS)
def test_the_defaults_are_in_their_ranges(name: str, command: Command, program: object) -> None:
    made = load(command.config)
    needed = {"policy": "p", "file": "f", "policies": ("p",), "camera": "c"}
    needed |= {"out": Path("o"), "site": Path("s"), "returned": Path("r")}
    fields = made.__dataclass_fields__
    given = {name: needed[name] for name in needed if name in fields}
    check_numbers(made(**given))


def test_a_number_out_of_range_leaves_no_run(tmp_path: Path) -> None:
    for light in (LightConfig(rounds=-1), LightConfig(learning_rate=float("nan"))):
        with pytest.raises(UserError, match=r"^--light\.\S+: expected a .* to \d+, found"):
            train(TrainConfig("toy/reach", out=tmp_path / "run", light=light))
    assert not any(tmp_path.iterdir())
