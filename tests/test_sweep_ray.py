"""A sweep on Ray: a fake of it, and a real cluster of two nodes, one of them killed."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from madviz.envs.custom import VARIABLE, own_tasks
from madviz.errors import UserError
from madviz.sweep.ray import RayBackend
from madviz.sweep.run import Run, RunOutcome
from madviz.sweep.sweep import SweepConfig, run_sweep
from tests.pages import await_that
from tests.sweeps import assert_done_once, config, stand_in


@pytest.fixture
def program(tmp_path: Path) -> list[str]:
    return stand_in(tmp_path)


def test_without_ray_the_error_names_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match="pip install 'madviz.cluster.'"):
        run_sweep(config(tmp_path, backend="ray"))


def test_a_sweep_that_is_local_never_imports_ray() -> None:
    code = "import sys, madviz.sweep.sweep; print('ray' in sys.modules)"
    asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert asked.stdout.strip() == "False"


class FakeRay:
    """Runs a task when it is asked for; the second one is lost with its node for good."""

    function: Any
    options: dict[str, Any]

    class exceptions:
        class RayError(Exception):
            pass

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.cancelled: list[Any] = []

    def is_initialized(self) -> bool:
        return True

    def nodes(self) -> list[dict[str, Any]]:
        cores = ((True, 4.0), (True, 3.0), (False, 64.0))
        return [{"Alive": alive, "Resources": {"CPU": count}} for alive, count in cores]

    def remote(self, **options: Any) -> Any:
        self.options = options

        def decorate(function: Any) -> Any:
            self.function = function
            return SimpleNamespace(remote=self.call)

        return decorate

    def call(self, *arguments: Any) -> int:
        self.calls.append(arguments)
        return len(self.calls) - 1

    def wait(self, references: list[int], num_returns: int, timeout: float) -> Any:
        return references[:num_returns], references[num_returns:]

    def get(self, reference: int) -> RunOutcome:
        if reference == 1:
            raise self.exceptions.RayError("the node died\nand more")
        return self.function(*self.calls[reference])

    def cancel(self, reference: int, force: bool) -> None:
        self.cancelled.append(reference)


def test_the_ray_backend_hands_runs_over_and_reports_those_that_ray_gave_up(
    tmp_path: Path, program: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", fake)
    with pytest.raises(UserError, match="a node with 8 cores for a run, found 4 at most"):
        run_sweep(config(tmp_path, backend="ray", cpus=8), program)
    result = run_sweep(config(tmp_path, backend="ray", cpus=2), program)
    assert (result["finished"], result["failed"]) == (3, 1)
    assert fake.options["num_cpus"] == 2 and fake.options["max_retries"] > 0
    error = next(run.get("error") for run in result["runs"] if run["state"] == "failed")
    assert error == "Ray gave the run up (RayError): the node died"
    backend = RayBackend(tmp_path, None, cpus=2)
    assert backend.slots == 2 + 1 and RayBackend(tmp_path, 2, cpus=1).slots == 2
    backend.submit(Run("a", (), ()))
    backend.close()
    assert len(fake.cancelled) == 1


def test_nodes_hear_which_tasks_of_ones_own_are_known(
    tmp_path: Path, program: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", FakeRay())
    monkeypatch.setenv(VARIABLE, "mine:push,mine:pull")
    backend = RayBackend(tmp_path, None, cpus=1, program=program)
    monkeypatch.delenv(VARIABLE)  # A node was started by somebody else, before.
    backend.submit(Run("a", (), ()))
    backend.collect(0.0)
    assert own_tasks() == ("mine:push", "mine:pull")
    monkeypatch.delenv(VARIABLE)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two raylets of one core each on this machine, and a driver that is connected to them."""
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    both = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = both.add_node(num_cpus=1)
    ray.init(address=both.address, log_to_driver=False)
    yield both, second
    ray.shutdown()
    both.shutdown()


@pytest.mark.slow
def test_on_ray_a_killed_node_costs_nothing_that_was_finished(
    tmp_path: Path, program: list[str], cluster: Any
) -> None:
    asked = config(tmp_path, rounds=40, pause=100, backend="ray", cpus=1)
    out, results = tmp_path / "out", []
    work = threading.Thread(target=lambda: results.append(run_sweep(asked, program)))
    work.start()
    await_that(lambda: len(list(out.glob("*/policy/steps.txt"))) == 2, patience=60)
    await_that(lambda: len(list(out.glob("*/result.json"))) == 2, patience=60)
    before = {file: file.stat().st_mtime_ns for file in out.glob("*/result.json")}
    await_that(lambda: len(list(out.glob("*/policy/steps.txt"))) == 4, patience=60)
    time.sleep(0.5)
    both, second = cluster
    both.remove_node(second, allow_graceful=False)
    work.join(120)
    assert results and results[0]["finished"] == 4
    assert {file: file.stat().st_mtime_ns for file in before} == before
    assert_done_once(out, rounds=40)
    logs = "".join(file.read_text() for file in out.glob("*/log.txt"))
    assert logs.count("--resume") == 1  # The run that was cut off, and no other.
    # Same file, same results as here.
    here = run_sweep(SweepConfig(asked.file, out=tmp_path / "here", jobs=4), program)
    for run in here["runs"]:
        name = f"{run['name']}/result.json"
        assert (tmp_path / "here" / name).read_bytes() == (out / name).read_bytes()


def test_a_cluster_that_does_not_start_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(**options: Any) -> None:
        raise Exception("The current node timed out during startup.\nSee the logs.")

    fake = SimpleNamespace(is_initialized=lambda: False, init=slow)
    monkeypatch.setitem(sys.modules, "ray", fake)
    with pytest.raises(UserError, match="found: The current node timed out") as refused:
        run_sweep(config(tmp_path, backend="ray"))
    assert "\n" not in str(refused.value)
