"""What simulations share: imported once, before they are forked."""

from __future__ import annotations

import gc
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from madviz import cli
from madviz.app import forking, server
from madviz.app.forking import prepare_for, shared_imports
from madviz.app.server import ExploreConfig, open_app
from madviz.commands import COMMANDS
from madviz.envs.registry import SUITES
from madviz.system.collection import imported


def test_a_task_names_modules_that_are_there_and_another_none():
    assert all(map(find_spec, shared_imports("maniskill/push-cube")))
    assert all(map(find_spec, shared_imports("metaworld/hammer")))
    assert shared_imports("maniskill/push-cube")
    assert shared_imports("toy/reach") == shared_imports("mine:make") == ()
    assert forking.SHARED.keys() <= SUITES.keys()


class Prepared(Exception):
    """The fork server would start now."""


@pytest.mark.parametrize("task", ["maniskill/push-cube", "metaworld/hammer"])
def test_the_fork_server_imports_the_simulator_of_the_first_policy(
    task: str, monkeypatch: pytest.MonkeyPatch
):
    def prepare(task: str) -> None:
        raise Prepared(task)

    monkeypatch.setattr(server, "prepare", prepare)
    with pytest.raises(Prepared) as started:
        open_app(ExploreConfig(policy=f"{task.replace('/', '-')}-mad-light", workers=0))
    assert started.value.args == (task,)


@pytest.mark.parametrize(
    ("words", "suites"),
    [
        ("", ["metaworld"]),
        ("--port 8081", ["metaworld"]),
        ("--task maniskill/push-cube", ["maniskill"]),
        ("--policy=maniskill-push-cube-mad-light", ["maniskill"]),
        ("--policy runs/toy-reach-mad-light/", ["toy"]),
        ("--policy sb3:model.zip@toy/reach", ["toy"]),
        ("--policy runs/mine", []),
        ("--policy ws://127.0.0.1:8000", []),
        ("--policy ws://127.0.0.1:8000 --task maniskill/push-cube", ["maniskill"]),
        ("--replay session.json", []),
        ("--recording data", []),
        ("--help", []),
    ],
)
def test_words_say_early_what_will_be_simulated(words, suites, monkeypatch):
    begun: list[str] = []
    monkeypatch.setattr(forking, "prepare", begun.append)
    prepare_for(words.split())
    assert begun == suites


def test_explore_begins_it_before_its_own_modules_are_imported(monkeypatch):
    def prepare(words: list[str]) -> None:
        raise Prepared(*words)

    monkeypatch.setattr(forking, "prepare_for", prepare)
    monkeypatch.setattr(cli, "parse", lambda *_: pytest.fail("its modules came first"))
    with pytest.raises(Prepared, match="--port"):
        cli.run(["explore", "--port", "1"], COMMANDS, "madviz")


CTRL_C = """
from multiprocessing import forkserver
from pathlib import Path
from madviz.app.forking import prepare

prepare("toy/reach")
for pid in (forkserver._forkserver._forkserver_pid, "self"):
    status = Path(f"/proc/{pid}/status").read_text()
    print(int(status.split("SigBlk:")[1].split()[0], 16) >> 1 & 1)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="what a process blocks stands in /proc")
def test_ctrl_c_is_for_the_page_alone():
    """In the fork server it would be a traceback in the middle of an import."""
    done = subprocess.run([sys.executable, "-c", CTRL_C], capture_output=True, text=True)
    assert (done.stdout.split(), done.stderr) == (["1", "0"], "")


def test_modules_are_imported_without_looking_for_garbage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(str(tmp_path))
    module = "import gc\nmade = [[] for _ in range(3)]\non = gc.isenabled()\n"
    for name in ("first_imported", "second_imported"):
        (tmp_path / f"{name}.py").write_text(module)
    first = imported("first_imported")
    assert not first.on and gc.isenabled()
    assert any(one is first.made[0] for one in gc.get_objects(generation=2)), "it counts as old"
    assert imported("first_imported") is first
    (tmp_path / "broken_imported.py").write_text("raise OSError")
    with pytest.raises(OSError):
        imported("broken_imported")
    assert gc.isenabled()
    gc.disable()
    try:
        assert not imported("second_imported").on and not gc.isenabled(), "as it was"
    finally:
        gc.enable()


BEGINNING = """
import gc
import madviz.session.fork_begin
assert not gc.isenabled()
import madviz.session.fork_server
assert gc.isenabled() and gc.get_freeze_count() > 100_000
"""
CHILD = """
import gc
from multiprocessing import get_context

def live(pipe):
    gc.freeze()
    from madviz.system.plugins import load
    load("colorsys:rgb_to_hls")
    pipe.send(gc.get_freeze_count())

if __name__ == "__main__":
    here, there = get_context("fork").Pipe()
    get_context("fork").Process(target=live, args=(there,)).start()
    assert here.recv() > 5_000, "still shared"
"""


def test_the_fork_server_collects_nothing_until_all_is_imported():
    subprocess.run([sys.executable, "-c", BEGINNING], check=True)


def test_what_a_forked_process_shares_stays_frozen():
    subprocess.run([sys.executable, "-c", CHILD], check=True)
