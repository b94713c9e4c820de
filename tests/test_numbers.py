"""Every number of every command has a range, and what is outside is refused in one line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from benchmarks.__main__ import BENCHMARKS, main
from madviz import cli
from madviz.commands import Command
from madviz.errors import UserError
from madviz.system.numbers import check_numbers, ranges
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig
from madviz.training.train import train
from tests.mistakes import refused

ODD = {"-1": -1.0, "0": 0.0, "nan": float("nan"), "inf": float("inf"), "1" + 30 * "0": 1e30}

ROWS = [
    *((name, command, cli.main) for name, command in cli.COMMANDS.items()),
    *((name, command, main) for name, command in BENCHMARKS.items()),
]
"""Name, command and the program's ``main``."""


@pytest.mark.parametrize(("name", "command", "program"), ROWS)
def test_every_number_is_refused_outside_its_range(
    name: str,
    command: Command,
    program: Callable[[Sequence[str]], int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    for option, kind, allowed in ranges(cli.named(command.config)):
        assert allowed is not None, f"{name} {option}: an option without a range"
        for text, value in ODD.items():
            if allowed.low <= value <= allowed.high and not (allowed.above and value == 0):
                continue
            for words in ([option, text], [f"{option}={text}"]):
                wanted = "a whole number" if kind is int else "a number"
                found = f"{allowed.high}, found {text}"
                line = refused([name, *words], found, capsys, program)
                assert line.startswith(f"madviz: {option}: expected {wanted} ")


def test_every_value_of_an_option_counts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["crowd", "--visitors", "1", "0", "4"]
    wanted = "--visitors: expected a whole number from 1 to 1000000, found 0"
    refused(words, wanted, capsys, main)


@pytest.mark.parametrize(("name", "command", "program"), ROWS)
def test_the_defaults_are_in_their_ranges(name: str, command: Command, program: object) -> None:
    made = cli.named(command.config)
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
