"""A disk that is full: trainings and recordings say so in a line and leave no half files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from madviz.cli import main
from madviz.errors import UserError
from madviz.recording.record import RecordConfig, run_record
from madviz.runs.run_folder import RunFolder
from madviz.system.files import PART
from madviz.training.config import TrainConfig
from madviz.training.train import train
from tests.disks import room_for


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*") if path.is_file()}


def test_a_run_that_cannot_begin_leaves_nothing(tmp_path: Path) -> None:
    with (
        room_for(),
        pytest.raises(UserError, match="found: .*File too large; choose") as error,
    ):
        train(TrainConfig(task="toy/reach", out=tmp_path / "run"))
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_a_state_is_whole_or_the_one_before(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", {"seed": 1}, resume=False, listener=None)
    folder.save_state({"step": 1})
    with room_for(20_000), pytest.raises((OSError, UserError)):
        folder.save_state({"step": 2, "weights": torch.zeros(100_000)})
    assert folder.load_state() == {"step": 1}
    assert files(tmp_path) == {"run.json", "state.pt"}


def test_what_a_kill_left_half_written_goes_when_the_run_goes_on(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", {"seed": 1}, resume=False, listener=None)
    folder.save_state({"step": 1})
    (folder.resume / "buffer").mkdir()
    for half in (folder.resume, folder.resume / "buffer"):
        (half / f"{PART}abc.pt").write_text("half")
    again = RunFolder(tmp_path / "run", {"seed": 1}, resume=True, listener=None)
    assert again.load_state() == {"step": 1}
    assert files(tmp_path) == {"run.json", "state.pt"}


@pytest.mark.parametrize("bad", [b'{"a"', b"garbage", b"PK\x03\x04" + bytes(3000)])
def test_files_of_a_run_that_are_damaged_are_named(tmp_path: Path, bad: bytes) -> None:
    folder = RunFolder(tmp_path / "run", {"seed": 1}, resume=False, listener=None)
    (folder.resume / "state.pt").write_bytes(bad)
    with pytest.raises(UserError, match="state.pt: expected the state of a run"):
        folder.load_state()
    (folder.resume / "run.json").write_bytes(bad)
    with pytest.raises(UserError, match="run.json: expected a JSON file"):
        RunFolder(tmp_path / "run", {"seed": 1}, resume=True, listener=None)


def test_a_curve_has_whole_rows(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", {"seed": 1}, resume=False, listener=None)
    folder.report("curve", step=1, loss=0.5)
    before = (tmp_path / "run" / "curve.csv").read_bytes()
    with room_for(len(before) + 3), pytest.raises(OSError):
        folder.report("curve", step=2, loss=0.25)
    assert (tmp_path / "run" / "curve.csv").read_bytes() == before


def test_a_training_that_runs_out_of_room_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*words: object) -> None:
        (tmp_path / "run" / "resume" / "state.pt").write_text("whole")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("madviz.training.train.RECIPES", {"light": FakeRecipe(no_room)})
    with pytest.raises(UserError, match="run: .*No space left on device; .*--resume"):
        train(TrainConfig(task="toy/reach", out=tmp_path / "run"))


class FakeRecipe:
    options = "light"

    def __init__(self, train: object) -> None:
        self.train = train


@pytest.mark.parametrize("ending", ["html", "rrd", "mp4"])
def test_a_recording_that_finds_no_room_leaves_no_file(ending: str, tmp_path: Path) -> None:
    config = RecordConfig(
        tmp_path / f"film.{ending}", policy="madviz.examples.own_policy:make", steps=3
    )
    with (
        room_for(),
        pytest.raises(UserError, match="^--out .*(written).*File too large") as error,
    ):
        run_record(config)
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_a_recording_that_runs_out_of_room_leaves_no_file(
    tmp_path: Path,
) -> None:
    config = RecordConfig(tmp_path / "report.html", policy="tests.fakes:FakePolicy", steps=3)
    with room_for(2_000), pytest.raises(UserError, match="^--out .*could not be written: File too"):
        run_record(config)
    assert list(tmp_path.iterdir()) == []


def test_a_command_that_runs_out_of_room_says_so_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("madviz.session.session_file.write_bytes", no_room)
    words = ["record", "--policy", "tests.fakes:FakePolicy", "--steps", "3"]
    kept = ["--out", str(tmp_path / "film.rrd"), "--keep", str(tmp_path / "kept.json")]
    assert main([*words, *kept]) == 2
    assert capsys.readouterr().err == "madviz: a file that it writes: No space left on device\n"
    assert files(tmp_path) == {"film.rrd"}
