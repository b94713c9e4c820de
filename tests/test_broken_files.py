"""One odd file in a policy's or a run's folder: it is named, and everything else works."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from madviz import cli
from madviz.app.server import first_choice, policy_choices, shipped_rates
from madviz.errors import UserError
from madviz.measure.compare import CompareConfig, run_compare
from madviz.measure.evaluate import EvalConfig, run_eval
from madviz.policies import checkpoint
from madviz.report.results import ReportConfig, report_words, run_report
from madviz.sweep.sweep import run_sweep, sweep_table
from madviz.system.files import read_json, read_toml
from tests.evidence import rates, write_policy
from tests.sweeps import config, stand_in

GOOD = rates(0.95, 0.9, 0.85, 0.8)
ODD_JSON = {
    "nothing": "null",
    "a list": "[]",
    "a number": "1",
    "deep": "[" * 100_000,
    "deep and closed": "[" * 500 + "]" * 500,
    "deep inside": '{"format": 1, "name": ' + '{"a": ' * 200 + "1" + "}" * 200 + "}",
    "a list for a name": '{"format": 1, "name": ["x"], "digest": ["x"]}',
    "a table for a format": '{"format": {}}',
    "half a pair of letters": '{"format": 1, "name": "\\ud800", "digest": "\\ud800"}',
    "a giant number": '{"format": 1e999, "digest": 1e999}',
    "a long number": '{"format": 1, "horizon": ' + "9" * 5000 + "}",
    "no text": "\x00",
}
odd_json = pytest.mark.parametrize("content", ODD_JSON.values(), ids=ODD_JSON)
odd_file = pytest.mark.parametrize("name", ["evaluation.json", "config.json"])


@pytest.fixture
def three(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Three policies; the last one is to be broken by a test."""
    root = tmp_path / "checkpoints"
    monkeypatch.setattr(checkpoint, "policy_roots", lambda: [root])
    return [write_policy(root, GOOD, method=m, folder=m) for m in ("mad", "merged-only", "mvd")]


def test_what_no_program_can_write_again_is_no_json(tmp_path: Path) -> None:
    file = tmp_path / "odd.json"
    for content in ("[" * 100_000, "[" * 60 + "]" * 60, "1e999", '"\\udc00"', '{"\\ud800": 1}'):
        file.write_text(content)
        with pytest.raises(UserError, match="odd.json: expected a JSON file, found: ") as error:
            read_json(file)
        assert len(str(error.value)) < 400
    file.write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(UserError, match="expected TOML, found: more than 50 lists and tables"):
        read_toml(file, "a file", "fix it")


@odd_json
@odd_file
def test_list_says_beside_its_name_that_a_policy_is_broken(
    name: str, content: str, three: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in three:
        (folder / "weights.safetensors").write_bytes(b"")
    (three[2] / name).write_text(content)
    assert cli.main(["list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "broken: " in lines["mvd"] and name in lines["mvd"]
    assert "not evaluated" in lines["mad"] and "not evaluated" in lines["merged-only"]


@odd_json
@odd_file
def test_rates_without_weights_may_be_broken_too(
    name: str, content: str, three: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.move(tmp_path / "checkpoints", tmp_path / "results" / "tables")
    (tmp_path / "results" / "tables" / "mvd" / name).write_text(content)
    assert cli.main(["list", "--all"]) == 0
    printed = capsys.readouterr().out
    assert (
        "all      0.95 [0.89, 0.98] n=100, development seeds" in printed and " broken: " in printed
    )


@odd_json
@odd_file
def test_the_page_names_what_is_broken_and_shows_the_others(
    name: str, content: str, three: list[Path]
) -> None:
    for folder in three:
        (folder / "weights.safetensors").write_bytes(b"")
    spec = checkpoint.describe(three[2]).spec
    (three[2] / name).write_text(content)
    *sound, broken = policy_choices(None)
    assert [choice.name for choice in sound] == ["mad", "merged-only"]
    assert broken.name == "mvd" and broken.label.startswith(f"mvd · broken: {name}: expected")
    assert first_choice([broken, *sound], None) == "mad"
    assert [choice.name for choice in policy_choices("metaworld/hammer")] == ["mad", "merged-only"]
    assert shipped_rates(str(three[2]), spec) == {}


@pytest.mark.parametrize("content", ["null", "[" * 100_000, ODD_JSON["a giant number"]])
@pytest.mark.parametrize("name", ["evaluation.json", "config.json", "development.json"])
def test_a_report_leaves_out_what_is_broken_and_says_so(
    name: str, content: str, three: list[Path], tmp_path: Path
) -> None:
    (three[2] / name).write_text(content)
    result = run_report(ReportConfig(tmp_path / "checkpoints"))
    assert result["policies"] == 2 and (tmp_path / "checkpoints" / "RESULTS.md").is_file()
    (broken,) = result["broken"]
    assert broken["name"] == "mvd" and "\nmvd broken: " in report_words(result)


@odd_json
@odd_file
def test_a_comparison_leaves_out_what_is_broken_and_says_so(
    name: str, content: str, three: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (three[2] / name).write_text(content)
    mad, merged, mvd = (str(folder) for folder in three)
    assert cli.main(["compare", mad, mvd, merged]) == 1
    printed = capsys.readouterr().out
    assert f"{mad} minus {merged}, paired by seed" in printed and "\nmvd broken: " in printed
    for policies in ((mad, mvd), (mvd, mad, merged)):
        with pytest.raises(UserError, match="nothing to compare: mvd broken: "):
            run_compare(CompareConfig(policies))


@odd_json
@pytest.mark.parametrize("name", ["run.json", "result.json"])
def test_a_sweep_goes_on_beside_a_broken_run(name: str, content: str, tmp_path: Path) -> None:
    program = stand_in(tmp_path)
    odd = tmp_path / "out" / "toy-reach-mad-light-seed1"
    odd.mkdir(parents=True)
    (odd / name).write_text(content)
    for _ in range(2):
        result = run_sweep(config(tmp_path, jobs=2, rounds=1), program)
        assert (result["finished"], result["failed"]) == (3, 1)
        assert f"failed    {odd.name}  broken: {odd / name}: expected" in sweep_table(result)
    assert run_sweep(config(tmp_path, dry_run=True, rounds=1))["failed"] == 1
    assert (odd / name).read_text() == content


@pytest.mark.parametrize("content", ["null", '{"training": 1}', "[" * 100_000])
def test_a_sweep_goes_on_beside_a_broken_policy(content: str, tmp_path: Path) -> None:
    odd = tmp_path / "out" / "toy-reach-mad-light-seed1" / "policy"
    odd.mkdir(parents=True)
    (odd / "config.json").write_text(content)
    result = run_sweep(config(tmp_path, jobs=2, rounds=1), stand_in(tmp_path))
    assert (result["finished"], result["failed"]) == (3, 1)


@odd_json
def test_a_card_over_a_broken_evaluation_is_refused_before_the_work(
    content: str, three: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (three[0] / "weights.safetensors").write_bytes(b"")
    (three[0] / "evaluation.json").write_text(content)
    monkeypatch.setattr("madviz.measure.evaluate.evaluate", None)
    with pytest.raises(UserError, match="evaluation.json: expected .*; .*restore it"):
        run_eval(EvalConfig("mad", card=True))
    assert (three[0] / "evaluation.json").read_text() == content


def test_what_was_measured_keeps_within_bounds(three: list[Path]) -> None:
    file = three[0] / "evaluation.json"
    document = json.loads(file.read_text())
    for key, odd in (("success", 1e300), ("n", 10**40), ("ci95", [0.5]), ("success_any", -1)):
        row = {**document["subsets"]["all"], key: odd}
        file.write_text(json.dumps({**document, "subsets": {"all": row}}))
        with pytest.raises(UserError, match="evaluation.json: "):
            run_compare(CompareConfig(("mad", "mvd")))
    for empty in ({"subsets": {}}, {"episodes": []}):
        file.write_text(json.dumps({**document, **empty}))
        with pytest.raises(UserError, match="evaluation.json: "):
            run_compare(CompareConfig(("mad", "mvd")))


def test_a_card_that_cannot_be_written_loses_no_episode(
    three: list[Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Measured:
        def to_json(self) -> Any:
            return {**document, "digest": ""}

    (three[0] / "weights.safetensors").write_bytes(b"")
    document = json.loads((three[0] / "evaluation.json").read_text())
    (three[0] / "evaluation.json").unlink()
    monkeypatch.setattr("madviz.measure.evaluate.evaluate", lambda *_, **__: Measured())
    (three[0] / "card.md").mkdir()
    with pytest.raises(UserError, match="^--card .*card.md: expected a file"):
        run_eval(EvalConfig("mad", card=True))
    assert not (three[0] / "evaluation.json").exists()
    (three[0] / "card.md").rmdir()
    monkeypatch.setattr("madviz.measure.evaluate.write_card", no_space)
    assert cli.main(["eval", "--policy", "mad", "--card"]) == 2
    printed, said = capsys.readouterr()
    assert '"episodes": [' in printed and "all  " in printed
    assert "could not be written: No space left" in said and said.count("\n") == 1


def no_space(*words: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")
