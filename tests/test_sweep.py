"""``sweep``: what a file asks for, what a kill costs, what goes where."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from madviz import cli
from madviz.envs.own import VARIABLE, own_tasks
from madviz.sweep import sweep
from madviz.sweep.plan import read_plan
from madviz.sweep.ray import RayBackend
from madviz.sweep.run import Outcome, Run, carry_out, claimed, expected_seconds
from madviz.sweep.sweep import LocalBackend, SweepConfig, Watch, carry_all_out, run_sweep
from madviz.types import UserError

PROGRAM = """
import json, sys, time
from pathlib import Path

verb, words = sys.argv[1], sys.argv[2:]


def option(name):
    return words[words.index(name) + 1]


if verb == "train":
    out = Path(option("--out"))
    (out / "resume").mkdir(parents=True, exist_ok=True)
    run = out / "resume" / "run.json"
    if run.exists() != ("--resume" in words):
        sys.exit("told to resume where there is nothing, or not where there is a run")
    run.write_text("{}")
    if option("--seed") == "13":
        sys.exit("madviz: the thirteenth always fails")
    steps = out / "steps.txt"
    done = len(steps.read_text().split()) if steps.exists() else 0
    for step in range(done, int(option("--light.rounds"))):
        time.sleep(int(option("--threads")) / 1000)
        with steps.open("a") as file:
            file.write(f"{step}\\n")
    (out / "config.json").write_text(json.dumps({"training": {"finished": True}}))
    with (out / "trained.txt").open("a") as file:
        file.write("once\\n")
else:
    policy = Path(option("--policy"))
    row = {"success": 0.5, "n": int(option("--episodes")), "ci95": [0.2, 0.8]}
    (policy / "evaluation.json").write_text(json.dumps({"subsets": {"all": row}}))
    with (policy / "evaluated.txt").open("a") as file:
        file.write("once\\n")
"""


def sweep_file(folder: Path, seeds: str = "[1, 2]", rounds: int = 3, pause: int = 0) -> str:
    """Two methods on one task; ``pause`` is in milliseconds for each of ``rounds`` steps."""
    file = folder / "rivals.toml"
    file.write_text(
        f'[grid]\ntasks = ["toy/reach"]\nmethods = ["mad", "merged-only"]\nseeds = {seeds}\n'
        f"[grid.train]\nlight.rounds = {rounds}\nthreads = {pause}\n[eval]\nepisodes = 4\n"
    )
    return str(file)


@pytest.fixture
def program(tmp_path: Path) -> list[str]:
    """Stands for ``madviz``: counts what it did, resumes, and fails with seed 13."""
    file = tmp_path / "program.py"
    file.write_text(PROGRAM)
    return [sys.executable, "-I", "-S", str(file)]


def config(tmp_path: Path, **change: Any) -> SweepConfig:
    sizes = {k: change.pop(k) for k in ("seeds", "rounds", "pause") if k in change}
    return SweepConfig(sweep_file(tmp_path, **sizes), out=tmp_path / "out", **change)


def lines(folder: Path, name: str) -> list[str]:
    return (folder / "policy" / name).read_text().split()


def assert_done_once(out: Path, rounds: int) -> None:
    """Every run has its result; no step, no training and no evaluation was done twice."""
    folders = sorted(path for path in out.iterdir() if path.is_dir())
    assert len(folders) == 4
    for folder in folders:
        assert (folder / "result.json").is_file()
        assert lines(folder, "steps.txt") == [str(step) for step in range(rounds)], folder
        assert lines(folder, "trained.txt") == lines(folder, "evaluated.txt") == ["once"]


# --- The file ---


def test_a_file_expands_to_runs_whose_names_say_what_varies(tmp_path: Path) -> None:
    file = tmp_path / "alpha.toml"
    file.write_text(
        '[[grid]]\ntasks = ["metaworld/hammer"]\nmethods = ["mad"]\nsettings = ["three-rgbd"]\n'
        "[grid.train]\nlight.alpha = [0.2, 1.0]\nlight.critic_updates = 0\n"
        '[[grid]]\ntasks = ["metaworld/push"]\nmethods = ["merged-only"]\nseeds = [7]\n'
        '[eval]\nepisodes = 9\nseed = 5000\nsubsets = ["all", "first"]\n'
    )
    plan = read_plan(file)
    assert plan.name == "alpha" and [run.name for run in plan.runs] == [
        "metaworld-hammer-mad-three-rgbd-light-alpha0.2-seed1",
        "metaworld-hammer-mad-three-rgbd-light-alpha1.0-seed1",
        "metaworld-push-merged-only-light-seed7",
    ]
    words = " ".join(plan.runs[0].train)
    assert words == (
        "--task metaworld/hammer --method mad --setting three-rgbd --recipe light --seed 1 "
        "--light.alpha 0.2 --light.critic-updates 0"
    )
    assert plan.runs[2].evaluate == (
        *("--episodes", "9", "--seed", "5000", "--subsets", "all", "first"),
    )


@pytest.mark.parametrize("command", ["train", "eval"])
def test_the_words_of_a_run_are_words_that_the_command_line_knows(
    command: str, tmp_path: Path
) -> None:
    from madviz.evaluate import EvalConfig
    from madviz.train import TrainConfig

    file = tmp_path / "one.toml"
    file.write_text(
        '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseeds = [4]\n[grid.train]\n'
        'light.rounds = 2\npaper.buffer-on-disk = true\n[eval]\nsubsets = ["all", "none"]\n'
    )
    run = read_plan(file).runs[0]
    if command == "train":
        found = cli.parse(TrainConfig, command, run.train)
        assert (found.seed, found.light.rounds, found.paper.buffer_on_disk) == (4, 2, True)
    else:
        asked = cli.parse(EvalConfig, command, ["--policy", "p", *run.evaluate, "--card"])
        assert asked.subsets == ("all", "none") and asked.card


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tasks = [", "expected TOML"),
        ("[grids]\n", "unknown table 'grids'; known: eval, grid"),
        ("", r"expected a table \[grid\]"),
        ('[grid]\nmethods = ["mad"]\n', "expected tasks to be a list of names, found None"),
        ('[grid]\ntasks = "toy/reach"\nmethods = ["mad"]\n', "tasks to be a list of names"),
        ('[grid]\ntasks = ["toy/rech"]\nmethods = ["mad"]\n', "unknown task 'toy/rech'; known"),
        ('[grid]\ntasks = ["toy/reach"]\nmethods = ["sad"]\n', "unknown method 'sad'; known"),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseeds = ["1"]\n',
            "seeds to be a list of whole numbers",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[grid.train]\nout = "x"\n',
            "expected other options",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[eval]\nepisodes = "many"\n',
            "expected episodes in .eval. to be a whole number, found 'many'",
        ),
    ],
)
def test_a_mistake_in_the_file_costs_nothing(text: str, expected: str, tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(UserError, match=expected):
        run_sweep(SweepConfig(str(file), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_missing_file_and_no_jobs_at_all_are_mistakes(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a sweep file, found: No such file"):
        run_sweep(SweepConfig(str(tmp_path / "none.toml")))
    with pytest.raises(UserError, match="expected 1 or more jobs"):
        run_sweep(config(tmp_path, jobs=0))


# --- The local backend ---


def test_a_sweep_trains_and_evaluates_every_run_once(tmp_path: Path, program: list[str]) -> None:
    first = run_sweep(config(tmp_path, jobs=2), program)
    assert (first["finished"], first["failed"], first["waiting"]) == (4, 0, 0)
    assert first["runs"][0]["subsets"]["all"] == {"success": 0.5, "n": 4, "ci95": [0.2, 0.8]}
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
    assert "the thirteenth always fails" in failed[0]["error"]
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


def wait_for(condition: Any, seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_sweep_goes_on_where_it_was(
    how: signal.Signals, tmp_path: Path, program: list[str]
) -> None:
    out, file = tmp_path / "out", sweep_file(tmp_path, rounds=30, pause=20)
    process = subprocess.Popen(script(tmp_path, program, file), stderr=subprocess.DEVNULL)
    wait_for(lambda: any(len(f.read_text().split()) > 5 for f in out.glob("*/policy/steps.txt")))
    assert not list(out.glob("*/result.json"))
    process.send_signal(how)
    process.wait(20)
    # The leash: the trainings end with their sweep, in mid-run.
    wait_for(lambda: all(free(folder) for folder in out.iterdir()))
    cut = [len(f.read_text().split()) for f in out.glob("*/policy/steps.txt")]
    assert max(cut) < 30
    result = run_sweep(config(tmp_path, rounds=30, pause=20, jobs=2), program)
    assert result["finished"] == 4
    assert_done_once(out, rounds=30)


def free(folder: Path) -> bool:
    with claimed(folder) as claim:
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
    plan = read_plan(sweep_file(tmp_path))
    folder = tmp_path / "out" / plan.runs[0].name
    folder.mkdir(parents=True)
    with claimed(folder) as claim:
        assert claim is not None
        assert carry_out(plan.runs[0], tmp_path / "out", program).state == "busy"
        kept = os.dup(claim)

    def release() -> None:
        wait_for(lambda: len(list((tmp_path / "out").glob("*/result.json"))) == 3)
        os.close(kept)

    somebody = threading.Thread(target=release)
    somebody.start()
    outcomes = carry_all_out(plan.runs, LocalBackend(tmp_path / "out", 1, program), Watch(4, 4))
    somebody.join()
    assert {outcome.state for outcome in outcomes.values()} == {"finished"}
    assert list(outcomes)[-1] == plan.runs[0].name  # The others went first.


def test_the_time_left_counts_what_runs_and_what_waits() -> None:
    clock, expected = Clock(), {}
    watch = Watch(6, 5, lambda run: expected.get(run.name), now=clock)
    first, second = Run("a", (), ()), Run("b", (), ())
    watch.began(first)
    assert watch.seconds_left() is None
    watch.ended(first, Outcome("finished", seconds=100.0))
    watch.tick(slots=2)
    clock.time = 10.0
    watch.began(second)
    clock.time = 40.0
    # 3 waiting runs of 100 s and 70 s of the one that runs, two at a time.
    assert watch.seconds_left() == pytest.approx((3 * 100 + 70) / 2)
    # The running one says that it will take 140 s in all: the mean is 120.
    expected["b"] = 140.0
    assert watch.seconds_left() == pytest.approx((3 * 120 + 90) / 2)


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


@pytest.mark.parametrize(
    ("seconds", "words"), [(45.2, "45 s"), (720, "12 min"), (11_100, "3 h 05 min")]
)
def test_durations_read_well(seconds: float, words: str) -> None:
    assert sweep.duration(seconds) == words


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


SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints"


@pytest.mark.parametrize("file", sorted(SHIPPED.glob("*.toml")), ids=lambda file: file.stem)
def test_the_sweeps_that_ship_ask_for_what_exists(file: Path, tmp_path: Path) -> None:
    result = run_sweep(SweepConfig(str(file), out=tmp_path / "out", dry_run=True))
    asked = tomllib.loads(file.read_text())
    assert result["finished"] == 0 and len(result["runs"]) >= len(asked["grid"])
    assert f"madviz sweep checkpoints/{file.name}" in file.read_text()


# --- Ray ---


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

    def get(self, reference: int) -> Outcome:
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
    error = next(run["error"] for run in result["runs"] if run["state"] == "failed")
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
    wait_for(lambda: len(list(out.glob("*/policy/steps.txt"))) == 2, seconds=60)
    wait_for(lambda: len(list(out.glob("*/result.json"))) == 2, seconds=60)
    kept = {file: file.stat().st_mtime_ns for file in out.glob("*/result.json")}
    wait_for(lambda: len(list(out.glob("*/policy/steps.txt"))) == 4, seconds=60)
    time.sleep(0.5)
    both, second = cluster
    both.remove_node(second, allow_graceful=False)
    work.join(120)
    assert results and results[0]["finished"] == 4
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert_done_once(out, rounds=40)
    logs = "".join(file.read_text() for file in out.glob("*/log.txt"))
    assert logs.count("--resume") == 1  # The run that was cut off, and no other.
    # Same file, same results as here.
    here = run_sweep(SweepConfig(asked.file, out=tmp_path / "here", jobs=4), program)
    for run in here["runs"]:
        name = f"{run['name']}/result.json"
        assert (tmp_path / "here" / name).read_bytes() == (out / name).read_bytes()
