"""What a command can ask of the reader of its words, on a configuration made for these tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.system.command_line import read
from madviz.system.numbers import Count, check_numbers
from madviz.system.options import OneOf


@dataclass(frozen=True)
class Sizes:
    """Options that every kind has."""

    width: Count = 64
    """Numbers in a layer."""


@dataclass(frozen=True)
class DeepSizes(Sizes):
    """Options of the kind deep."""

    width: Count = 512
    """Numbers in a layer."""
    depth: Count = 3
    """Layers,
    ``one`` or more."""


@dataclass(frozen=True)
class ToyConfig:
    """A command of the tests."""

    kind: Annotated[str, OneOf("kind", ("flat", "deep"))] = "flat"
    """Which sizes there are."""
    rounds: Count | None = None
    """How often."""
    sizes: Sizes = field(default_factory=Sizes)

    @classmethod
    def renamed_options(cls) -> dict[str, str]:
        """Older spellings."""
        return {"--wide": "--sizes.width", "--old-kind": "--kind"}


def toy_default(words: Sequence[str]) -> ToyConfig:
    """The class of sizes follows from the kind."""
    return ToyConfig(sizes=DeepSizes() if "deep" in words else Sizes())


def toy_work(config: ToyConfig) -> ToyConfig:
    return config


def toy(*words: str) -> ToyConfig:
    return read(ToyConfig, words, "madviz toy", "A toy.", default=toy_default(words))


def test_a_group_has_the_options_and_values_of_its_default() -> None:
    assert toy() == ToyConfig()
    assert toy("--kind", "deep").sizes == DeepSizes()
    assert toy("--kind", "deep", "--sizes.depth", "5").sizes == DeepSizes(depth=5)
    assert type(toy("--sizes.width", "2").sizes) is Sizes
    with pytest.raises(
        UserError, match=r"^unknown option --sizes.depth; did you mean --sizes.width"
    ):
        toy("--sizes.depth", "5")
    with pytest.raises(UserError, match=r"^--sizes.depth: expected a whole number .* found 0$"):
        toy("--kind", "deep", "--sizes.depth", "0")
    with pytest.raises(UserError, match=r"^--sizes.depth: expected a whole number .* found 0$"):
        check_numbers(ToyConfig(sizes=DeepSizes(depth=0)))


def test_the_help_of_a_group_is_that_of_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        toy("--help")
    assert "--sizes.depth" not in capsys.readouterr().out
    with pytest.raises(SystemExit):
        toy("--kind", "deep", "--help")
    printed = capsys.readouterr().out
    assert "Layers, one or more. (default: 3)" in " ".join(printed.replace("│", " ").split())


def test_the_table_of_commands_names_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    place = "tests.test_command_line"
    command = replace(
        cli.COMMANDS["list"],
        config=f"{place}:ToyConfig",
        work=f"{place}:toy_work",
        default=f"{place}:toy_default",
    )
    monkeypatch.setitem(cli.COMMANDS, "toy", command)
    assert cli.parse("toy", ["--kind", "deep"]).sizes == DeepSizes()


@pytest.mark.parametrize("words", [("--wide", "7"), ("--wide=7",)])
def test_an_older_spelling_is_read_with_a_note(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert toy(*words) == ToyConfig(sizes=Sizes(7))
    assert capsys.readouterr().err == "madviz: --wide is now --sizes.width\n"
    assert toy("--old_kind", "flat") == ToyConfig()
    with pytest.raises(UserError, match=r"^expected --sizes.width once, found it twice"):
        toy("--wide", "7", "--sizes.width", "8")


def test_names_and_numbers_that_do_not_fit_are_one_line() -> None:
    with pytest.raises(UserError, match="^unknown kind 'dep'; did you mean deep. known: deep, "):
        toy("--kind", "dep")
    with pytest.raises(UserError, match="^--rounds: expected a whole number .* found 0$"):
        toy("--rounds", "0")
    assert toy("--rounds", "None").rounds is None
