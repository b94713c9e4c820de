"""Every number of every command has a range, and what is outside is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.system.numbers import check_numbers, ranges
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig
from madviz.training.train import train
from tests.mistakes import refused

ODD = {"-1": -1.0, "0": 0.0, "nan": float("nan"), "inf": float("inf"), "1" + 30 * "0": 1e30}


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_number_is_refused_outside_its_range(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, kind, allowed in ranges(cli.named(cli.COMMANDS[command].config)):
        assert allowed is not None, f"{command} {option}: an option without a range"
        for text, value in ODD.items():
            if allowed.low <= value <= allowed.high and not (allowed.above and value == 0):
                continue
            for words in ([option, text], [f"{option}={text}"]):
                wanted = "a whole number" if kind is int else "a number"
                found = f"{allowed.high}, found {text}"
                line = refused([*command.split(), *words], found, capsys)
                assert line.startswith(f"madviz: {option}: expected {wanted} ")


def test_every_value_of_an_option_counts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "crowd", "--visitors", "1", "0", "4"]
    refused(words, "--visitors: expected a whole number from 1 to 1000000, found 0", capsys)


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_defaults_are_in_their_ranges(command: str) -> None:
    config = cli.COMMANDS[command]
    made = cli.named(config.config)
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
