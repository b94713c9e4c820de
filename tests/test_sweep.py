"""``sweep`` on this machine: what a kill costs, what goes where."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.sweep import sweep
from madviz.sweep.run import (
    CLAIM,
    Run,
    RunOutcome,
    carry_out,
    check_same,
    expected_seconds,
    result_rows,
    trained,
)
from madviz.sweep.sweep import LocalBackend, Watch, carry_all_out, run_sweep
from madviz.sweep.sweep_plan import read_plan
from madviz.system.lock import locked
from tests.pages import await_that
from tests.sweeps import assert_done_once, config, lines, stand_in, sweep_file


@pytest.fixture
def program(tmp_path: Path) -> list[str]:
    return stand_in(tmp_path)


def test_a_sweep_trains_and_evaluates_every_run_once(tmp_path: Path, program: list[str]) -> None:
    first = run_sweep(config(tmp_path, jobs=2), program)
    assert (first["finished"], first["failed"], first["waiting"]) == (4, 0, 0)
    assert first["runs"][0].get("subsets", {})["all"] == {
        "success": 0.5,
        "n": 4,
        "ci95": [0.2, 0.8],
    }
    assert run_sweep(config(tmp_path, jobs=2), program) == first
    assert_done_once(tmp_path / "out", rounds=3)
    # More seeds in the file: only they are run.
    more = run_sweep(config(tmp_path, jobs=2, seeds="[1, 2, 3]"), program)
    assert more["finished"] == 6
    assert lines(tmp_path / "out" / "toy-reach-mad-light-seed1", "evaluated.txt") == ["once"]


def test_a_failing_run_stops_no_other_and_is_named_at_the_end(
    tmp_path: Path, program: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    result = run_sweep(config(tmp_path, seeds="[13, 1]", jobs=2), program)
    assert (result["finished"], result["failed"]) == (2, 2)
    failed = [run for run in result["runs"] if run["state"] == "failed"]
    assert "the thirteenth always fails" in failed[0].get("error", "")
    words = sweep.sweep_table(result)
    assert words.index("seed1 ") < words.index("failed    toy-reach-mad-light-seed13")
    assert "4 of 4: " in capsys.readouterr().err
    # It is tried again, with --resume because its folder holds a run.
    assert run_sweep(config(tmp_path, seeds="[13, 1]", jobs=2), program)["failed"] == 2
    log = (tmp_path / "out" / "toy-reach-mad-light-seed13" / "log.txt").read_text()
    assert log.count("--resume") == 1 and "where there is nothing" not in log


def test_a_dry_run_only_tells(tmp_path: Path, program: list[str]) -> None:
    asked = config(tmp_path, dry_run=True)
    result = run_sweep(asked, program)
    assert (result["waiting"], result["dry_run"]) == (4, True)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_options_is_refused_before_anything_runs(
    tmp_path: Path, program: list[str]
) -> None:
    run_sweep(config(tmp_path, seeds="[1]", jobs=2), program)
    with pytest.raises(UserError, match="--light.rounds 9.*found one of.*--light.rounds 3"):
        run_sweep(config(tmp_path, seeds="[1]", rounds=9), program)


def test_options_of_a_command_that_did_nothing_yet_may_be_corrected(
    tmp_path: Path, program: list[str]
) -> None:
    (wrong, *_) = read_plan(sweep_file(tmp_path, seeds="[1]"))
    typo = replace(wrong, evaluate=("--subsets", "frist"))  # The stand-in wants --episodes.
    assert carry_out(typo, tmp_path / "out", program).state == "failed"
    assert carry_out(wrong, tmp_path / "out", program).state == "finished"
    folder = tmp_path / "out" / wrong.name
    assert lines(folder, "trained.txt") == ["once"]
    with pytest.raises(UserError, match="madviz eval"):
        check_same(folder, typo)
    assert "madviz eval" in carry_out(typo, tmp_path / "out", program).error


def test_a_result_has_what_its_evaluation_measured(tmp_path: Path, program: list[str]) -> None:
    (run, *_) = read_plan(sweep_file(tmp_path, seeds="[1]"))
    folder = tmp_path / "out" / run.name
    (folder / "policy").mkdir(parents=True)
    (folder / "policy" / "evaluation.json").write_text('{"subsets": {"other": {}}}')
    assert carry_out(run, tmp_path / "out", program).state == "finished"
    assert list(result_rows(folder)) == ["all"]


def test_a_training_whose_last_evaluation_is_due_is_not_over(tmp_path: Path) -> None:
    (tmp_path / "resume").mkdir()
    (tmp_path / "config.json").write_text('{"training": {"finished": true}}')
    assert trained(tmp_path)
    (tmp_path / "resume" / "run.json").write_text("{}")
    assert not trained(tmp_path)
    (tmp_path / "resume" / "finished").touch()
    assert trained(tmp_path)


def test_a_training_that_ended_early_is_a_failure(tmp_path: Path) -> None:
    file = tmp_path / "half.py"
    file.write_text("import sys; sys.exit(0)")
    run = Run("half", ("--seed", "1"), ())
    outcome = carry_out(run, tmp_path, [sys.executable, str(file)])
    assert outcome.state == "failed" and "training ended before it was finished" in outcome.error


def script(tmp_path: Path, program: list[str], file: str) -> list[str]:
    """A sweep in a process of its own, to be killed."""
    code = (
        "import sys; from pathlib import Path\n"
        "from madviz.sweep.sweep import SweepConfig, run_sweep\n"
        f"run_sweep(SweepConfig({file!r}, out=Path({str(tmp_path / 'out')!r}), jobs=2), {program})"
    )
    return [sys.executable, "-c", code]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_sweep_goes_on_where_it_was(
    how: signal.Signals, tmp_path: Path, program: list[str]
) -> None:
    out, file = tmp_path / "out", sweep_file(tmp_path, rounds=30, pause=20)
    process = subprocess.Popen(script(tmp_path, program, file), stderr=subprocess.DEVNULL)
    await_that(lambda: any(len(f.read_text().split()) > 5 for f in out.glob("*/policy/steps.txt")))
    assert not list(out.glob("*/result.json"))
    process.send_signal(how)
    process.wait(20)
    # The trainings end with their sweep, in mid-run.
    await_that(lambda: all(free(folder) for folder in out.iterdir()))
    cut = [len(f.read_text().split()) for f in out.glob("*/policy/steps.txt")]
    assert max(cut) < 30
    result = run_sweep(config(tmp_path, rounds=30, pause=20, jobs=2), program)
    assert result["finished"] == 4
    assert_done_once(out, rounds=30)


def free(folder: Path) -> bool:
    with locked(folder / CLAIM) as claim:
        return claim is not None


def test_two_sweeps_share_a_folder(tmp_path: Path, program: list[str]) -> None:
    file = sweep_file(tmp_path, rounds=5, pause=20)
    both = [subprocess.Popen(script(tmp_path, program, file)) for _ in range(2)]
    assert [process.wait(40) for process in both] == [0, 0]
    assert_done_once(tmp_path / "out", rounds=5)


def test_a_run_that_somebody_else_works_on_waits_its_turn(
    tmp_path: Path, program: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "BUSY_SECONDS", 0.1)
    runs = read_plan(sweep_file(tmp_path))
    folder = tmp_path / "out" / runs[0].name
    folder.mkdir(parents=True)
    with locked(folder / CLAIM) as claim:
        assert claim is not None
        assert carry_out(runs[0], tmp_path / "out", program).state == "busy"
        held = os.dup(claim)

    def release() -> None:
        await_that(lambda: len(list((tmp_path / "out").glob("*/result.json"))) == 3)
        os.close(held)

    somebody = threading.Thread(target=release)
    somebody.start()
    outcomes = carry_all_out(runs, LocalBackend(tmp_path / "out", 1, program), Watch(4, 4))
    somebody.join()
    assert {outcome.state for outcome in outcomes.values()} == {"finished"}
    assert list(outcomes)[-1] == runs[0].name  # The others went first.


def test_the_time_left_counts_what_runs_and_what_waits() -> None:
    clock, expected = Clock(), {}
    watch = Watch(6, 5, lambda run: expected.get(run.name), now=clock)
    first, second = Run("a", (), ()), Run("b", (), ())
    watch.began(first)
    assert watch.seconds_left() is None
    watch.ended(first, RunOutcome("finished", seconds=100.0))
    watch.tick(slots=2)
    clock.time = 10.0
    watch.began(second)
    clock.time = 40.0
    # 3 waiting runs of 100 s and 70 s of the one that runs, two at a time.
    assert watch.seconds_left() == pytest.approx((3 * 100 + 70) / 2)
    # The running one says that it will take 140 s in all: the mean is 120.
    expected["b"] = 140.0
    assert watch.seconds_left() == pytest.approx((3 * 120 + 90) / 2)
    # Another sweep finished one of those that waited: it took no time here.
    third = Run("c", (), ())
    watch.began(third)
    watch.ended(third, RunOutcome("finished"))
    assert watch.seconds_left() == pytest.approx((2 * 120 + 90) / 2)


def test_a_training_says_how_long_it_will_take(tmp_path: Path) -> None:
    assert expected_seconds(tmp_path) is None
    (tmp_path / "policy").mkdir()
    curve = tmp_path / "policy" / "curve.csv"
    curve.write_text("round,seconds,seconds_left\n1,10.0,90.0\n2,30.0,50.0\n")
    assert expected_seconds(tmp_path) == 80.0
    curve.write_text("step,success_all\n1,0.5\n")
    assert expected_seconds(tmp_path) is None


class Clock:
    time = 0.0

    def __call__(self) -> float:
        return self.time


# --- The command ---


def test_the_command_prints_json_alone_and_ends_with_1_after_a_failure(
    tmp_path: Path, program: list[str], monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    monkeypatch.setattr(
        sweep, "_backend", lambda config, out, _: LocalBackend(out, config.jobs or 1, program)
    )
    words = ["sweep", sweep_file(tmp_path, seeds="[13]"), "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--json", "-"]) == 1
    printed = capfd.readouterr()
    assert json.loads(printed.out)["failed"] == 2 and "[sweep]" in printed.err
    assert cli.main(["sweep", sweep_file(tmp_path), *words[2:], "--dry-run"]) == 0
    assert "4 waiting" in capfd.readouterr().out
