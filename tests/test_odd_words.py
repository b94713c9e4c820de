"""Words of a command line that no program expects: one line each, and exit code 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from madviz.errors import UserError
from tests.mistakes import refused

LONG = "x" * 300
OWN = ("--policy", "madviz.examples.own_policy:make")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("eval", "--policy", LONG), "unknown policy"),
        (("eval", "--policy", "ring"), "unknown policy"),
        (("eval", "--policy", "ring/ring"), "unknown policy"),
        (("eval", "--policy", "os:system"), "os:system: expected module:factory"),
        (("eval", "--policy", f"{LONG}:make"), "expected module:factory"),
        (("eval", "--policy", "os:getpid"), "expected a Policy"),
        (("compare", LONG, LONG), "unknown policy"),
        (("compare", "ring", "ring"), "unknown policy"),
        (("record", "--replay", LONG, "--out", "x.html"), "File name too long"),
        (("record", "--replay", "ring", "--out", "x.html"), "symbolic links"),
        (("record", *OWN, "--out", f"{LONG}.html"), "File name too long"),
        (("record", *OWN, "--out", "/proc/x.html"), "a place that can be written to"),
        (("train", "--task", LONG), "unknown task"),
        (("train", "--task", "toy/reach", "--out", LONG), "File name too long"),
        (("train", "--task", "toy/reach", "--out", "ring"), "ring"),
        (("train", "--task", "toy/reach", "--out", "/proc/x"), "/proc/x"),
        (("train", "--task", "toy/reach", "--cameras", LONG), "File name too long"),
        (("train", "--task", "toy/reach", "--cameras", "deep.toml"), "inside one another"),
        (("sweep", LONG), "File name too long"),
        (("sweep", "ring"), "symbolic links"),
        (("sweep", "deep.toml"), "inside one another"),
        (("report", "--folder", LONG), "found no folder"),
        (("eval", *OWN, "--subsets", "all", "--subsets", "first"), "--subsets once"),
        (("eval", *OWN, "--occlude", "first=black", "first=blur"), "found 'first' twice"),
        (("explore", "--speed", "nan"), "--speed: expected a number above 0"),
        (("explore", "--speed", "inf"), "--speed: expected a number above 0"),
        (("eval", "--episodes", "5"), "expected --policy, found nothing; --help explains"),
        (("sweep",), "expected file, found nothing; --help explains"),
        (("list", "odd"), "unexpected word odd; --help lists all"),
        (("list", "-x"), "unknown option -x; --help lists all"),
        (("eval", *OWN, "--seed"), "--seed: expected a value after it"),
        (("explore", "--speed", "--seed", "2"), "--speed: expected a value after it"),
        (("train", "--threads", "many"), "--threads: expected a whole number from 1 to 256, found"),
        (("list", "--json"), "--json: expected a value after it"),
    ],
)
def test_odd_words_are_refused_in_one_line(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ring").symlink_to("ring")
    Path("deep.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    refused(words, said, capsys)
    assert {path.name for path in tmp_path.iterdir()} == {"ring", "deep.toml"}


def test_whatever_was_found_the_error_is_one_line_that_can_be_printed() -> None:
    said = str(UserError("found 'a\nb\x1b[2J\ud800' and " + "x" * 9000))
    assert said.startswith(r"found 'a\nb\x1b[2J\ud800' and xxx") and len(said) < 3010
