"""Standard streams that are closed, full or left by their reader, and SIGTERM: no traceback, and
the exit code that was promised."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from madviz import cli
from madviz.errors import Interrupted, Terminated, UserError
from madviz.system.signals import terminable
from madviz.training.config import TrainConfig
from madviz.training.train import train

MADVIZ = f"{shlex.quote(sys.executable)} -m madviz"
OWN = "--policy madviz.examples.own_policy:make"


def shell(line: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """``line`` in bash, where ``madviz`` is this one; what is told is the code of ``madviz``."""
    words = ["bash", "-c", f"{line.replace('madviz ', MADVIZ + ' ', 1)}; exit ${{PIPESTATUS[0]}}"]
    return subprocess.run(words, capture_output=True, text=True, cwd=cwd, timeout=120)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("madviz list | true", 0),
        ("madviz list | head -1", 0),
        ("madviz list --json - | true", 0),
        ("madviz --help | true", 0),
        ("madviz --version | true", 0),
        ("madviz train --help | true", 0),
        ("madviz bench | true", 2),
        ("madviz wurst | true", 2),
        ("madviz wurst 2>&1 | true", 2),
        ("madviz list >&-", 0),
        ("madviz list --json - >&-", 0),
        ("madviz wurst 2>&-", 2),
        ("madviz wurst >&- 2>&- <&-", 2),
        ("madviz wurst 2>/dev/full", 2),
    ],
)
def test_a_reader_who_leaves_changes_no_exit_code(line: str, code: int, tmp_path: Path) -> None:
    ended = shell(line, tmp_path)
    assert ended.returncode == code, ended.stderr
    assert "Traceback" not in ended.stderr and "Exception ignored" not in ended.stderr


@pytest.mark.parametrize("words", ["list", "list --json -", "--help", "train --help", "--version"])
def test_a_full_standard_output_is_one_line(words: str, tmp_path: Path) -> None:
    ended = shell(f"madviz {words} > /dev/full", tmp_path)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("madviz: standard output: expected a place that can be written")


def test_what_was_measured_is_in_the_file_though_it_cannot_be_printed(tmp_path: Path) -> None:
    line = f"madviz eval {OWN} --episodes 1 --workers 0 --json kept.json > /dev/full"
    ended = shell(line, tmp_path)
    assert ended.returncode == 2 and "No space left" in ended.stderr
    assert '"episodes"' in (tmp_path / "kept.json").read_text()


def test_a_training_goes_on_when_nobody_reads_what_it_says(tmp_path: Path) -> None:
    options = "--light.rounds 2 --light.demonstrations 2 --light.critic-updates 2"
    options += " --light.episodes-per-round 2 --light.updates-per-round 3"
    options += " --light.batch-size 4 --light.hidden-dim 16"
    ended = shell(f"madviz train --task toy/reach --out run {options} 2>&1 | true", tmp_path)
    assert ended.returncode == 0
    assert (tmp_path / "run" / "resume" / "finished").exists()


def test_sigterm_is_an_exception_and_the_second_one_an_end() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Terminated), terminable():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)
    assert signal.getsignal(signal.SIGTERM) == before
    program = (
        "import os, signal, time\n"
        "from madviz.system.signals import terminable\n"
        "with terminable():\n"
        "    try: os.kill(os.getpid(), signal.SIGTERM); time.sleep(9)\n"
        "    finally: os.kill(os.getpid(), signal.SIGTERM); time.sleep(9)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True)
    assert ended.returncode == -signal.SIGTERM


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_page_and_leaves_nothing(number: int, code: int, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "madviz", "explore", "--port", "0", "--workers", "1"]
    words += ["--policy", "madviz.examples.own_policy:make"]
    home = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=home, cwd=tmp_path
    ) as page:
        assert page.stdout is not None
        while not page.stdout.readline().startswith("(Ctrl-C"):
            assert page.poll() is None
        time.sleep(1.0)
        page.send_signal(number)
        _, said = page.communicate(timeout=60)
    assert (page.returncode, said) == (code, "madviz: stopped\n")


@pytest.mark.parametrize("words", ["train --task toy/reach", f"eval {OWN}", "list"])
def test_a_signal_before_anything_began_says_that_nothing_is_lost(
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)

    def stopped(reference: str) -> None:
        raise Terminated

    monkeypatch.setattr(cli, "load", stopped)
    assert cli.main(words.split()) == 143
    assert capsys.readouterr().err == ("madviz: stopped; it had not begun, so nothing is lost\n")
    assert list(tmp_path.iterdir()) == []


class Recipe:
    """Stops where a real one has not come to its loop."""

    options = "light"

    def __init__(self, saved: bool, error: type[BaseException]) -> None:
        self.saved, self.error = saved, error

    def train(self, plan: object, options: object, folder) -> None:
        if self.saved:
            (folder.resume / "episodes").mkdir()
        raise self.error


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt, 130), (Terminated, 143)])
@pytest.mark.parametrize("saved", [False, True])
def test_a_training_stopped_before_its_loop_says_how_it_goes_on(
    saved: bool,
    error: type[BaseException],
    code: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("madviz.training.train.RECIPES", {"light": Recipe(saved, error)})
    with pytest.raises(Interrupted) as stopped:
        train(TrainConfig(task="toy/reach", out=tmp_path / "run"))
    assert stopped.value.exit_code == code
    if saved:
        assert str(stopped.value).startswith("resume with: madviz train --task toy/reach")
        assert str(stopped.value).endswith(f"--out {tmp_path}/run --resume")
    else:
        assert str(stopped.value) == "it had not begun, so nothing is lost"
        assert list(tmp_path.iterdir()) == []
        with pytest.raises(UserError, match="nothing to resume"):
            train(TrainConfig(task="toy/reach", out=tmp_path / "run", resume=True))
