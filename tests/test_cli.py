"""The command line: what goes where, and how it ends."""

from __future__ import annotations

import ast
import inspect
import json
import os
import subprocess
import sys
import textwrap
from dataclasses import is_dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from benchmarks.__main__ import BENCHMARKS, PROGRAM
from benchmarks.__main__ import main as benchmark
from madviz import cli
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.methods import METHODS
from madviz.envs.registry import SETTINGS, TASKS
from madviz.errors import UserError, perhaps, saving, unknown
from madviz.policies.checkpoint import policy_folders
from madviz.policies.listing import ListConfig
from madviz.system.plugins import load
from madviz.training.config import RECIPES
from tests.mistakes import refused

TABLES = {"madviz": cli.COMMANDS, PROGRAM: BENCHMARKS}
ROWS = [(prog, name) for prog, table in TABLES.items() for name in table]


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "madviz", *words]
    return subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **environment}
    )


def test_help_names_every_command_and_loads_next_to_nothing() -> None:
    program = (
        "import sys; from madviz.cli import main; main(['--help']);"
        "print(*{'torch', 'viser', 'mujoco', 'tyro'} & set(sys.modules), file=sys.stderr)"
    )
    asked = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    for name in cli.COMMANDS:
        assert f"\n  {name} " in asked.stdout
    assert asked.stderr.strip() == ""


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"madviz {version('madviz')}\n"


@pytest.mark.parametrize(("prog", "name"), ROWS)
def test_every_line_of_the_table_names_what_exists(prog: str, name: str) -> None:
    command = TABLES[prog][name]
    assert is_dataclass(load(command.config)) and callable(load(command.work))
    assert not command.words or callable(load(command.words))


@pytest.mark.parametrize(("prog", "name"), ROWS)
def test_every_command_explains_its_options(
    prog: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([name, "--help"], TABLES[prog], prog)
    printed = capsys.readouterr().out
    command = TABLES[prog][name]
    assert ended.value.code == 0 and f"usage: {prog} {name}" in printed
    assert command.summary in printed
    assert f"Example:\n  {prog} {command.example}\n" in printed


@pytest.mark.parametrize(("prog", "name"), ROWS)
def test_every_example_is_a_command_that_can_be_read(prog: str, name: str) -> None:
    command = TABLES[prog][name]
    first, *words = command.example.split()
    assert first == name
    config = cli.parse(name, words, TABLES[prog], prog)
    assert type(config) is load(command.config)


def printed_by(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What a command prints before it ends by itself, without boxes and line breaks."""
    with pytest.raises(SystemExit):
        cli.main(words)
    return " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_help_lists_the_names_that_an_option_takes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    printed = printed_by(capsys, "train", "--help")
    for names in (METHODS, SETTINGS, RECIPES, MERGES):
        assert "{" + ",".join(names) + "}" in printed.replace(" ", "")
    printed = printed_by(capsys, "explore", "--help")
    assert [name for name in (*TASKS, *policy_folders()) if f" {name}" not in printed] == []


@pytest.mark.parametrize("recipe", RECIPES)
def test_help_has_the_options_of_the_chosen_recipe_alone(
    recipe: str, capsys: pytest.CaptureFixture[str]
) -> None:
    printed = printed_by(capsys, "train", "--recipe", recipe, "--help")
    options = {name: f"--{row.options.replace('_', '-')}." for name, row in RECIPES.items()}
    shown = [name for name, option in options.items() if f"{option}hidden-dim" in printed]
    assert shown == [recipe]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train --method madd", "unknown method 'madd'; did you mean mad? known: attention"),
        ("train --state paperr", "unknown state 'paperr'; did you mean paper? known: code"),
        ("train --merge summ", "unknown merge 'summ'; did you mean sum? known: attention"),
        ("eval --polcy x", "unknown option --polcy; did you mean --policy?"),
        ("eval --wurst", "unknown option --wurst; --help lists all"),
    ],
)
def test_options_and_names_that_do_not_fit_are_refused_in_one_line(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    refused(words.split(), said, capsys)


def test_a_flag_can_be_switched_on_and_off_by_name() -> None:
    assert cli.parse("train", ["--resume"]).resume
    assert cli.parse("explore", ["--no-token", "--light"]).token is False
    assert cli.parse("train", ["--light.batch_size", "32"]).light.batch_size == 32


def test_the_shell_completes_commands_options_and_names(tmp_path: Path) -> None:
    script = tmp_path / "madviz.bash"
    script.write_text(cli.script_of("bash"))
    expected = {
        ("tra",): "train",
        ("train", "--reci"): "--recipe",
        ("train", "--method", "singu"): "singular-only",
    }
    asked = [f"source {script}"]
    for words in expected:
        typed = " ".join(f"'{word}'" for word in ("madviz", *words))
        asked += [
            f"COMPREPLY=(); COMP_WORDS=({typed}); COMP_CWORD={len(words)}",
            "$(complete -p madviz | sed 's/.*-F \\([^ ]*\\).*/\\1/'); echo ${COMPREPLY[*]}",
        ]
    said = subprocess.run(["bash", "-c", "\n".join(asked)], capture_output=True, text=True)
    assert said.stdout.splitlines() == list(expected.values()), said.stderr


def test_completion_is_for_shells_that_are_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--completion", "bsh"]) == 2
    assert "did you mean bash? known: bash, fish, zsh" in capsys.readouterr().err


def without_words(config: Any) -> list[str]:
    """Options that no docstring follows, also those of nested groups."""
    found = []
    hints: dict[str, Any] = get_type_hints(config)
    kinds = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    for parent in config.__mro__[:-1]:
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(parent))).body
        assert isinstance(tree, ast.ClassDef)
        for field, words in pairwise([*tree.body, ast.Pass()]):
            name = ast.unparse(field.target) if isinstance(field, ast.AnnAssign) else ""
            if name and name not in kinds and not isinstance(words, ast.Expr):
                found.append(f"{parent.__name__}.{name}")
    return found + [name for group in kinds.values() for name in without_words(group)]


@pytest.mark.parametrize(("prog", "name"), ROWS)
def test_every_option_has_a_line_of_help(prog: str, name: str) -> None:
    assert without_words(load(TABLES[prog][name].config)) == []


def test_without_a_command_the_usage_is_an_error() -> None:
    asked = run()
    assert asked.returncode == 2 and asked.stdout == "" and "usage: madviz" in asked.stderr


def test_unknown_commands_list_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["wurst"]) == 2
    assert capsys.readouterr().err == (
        "madviz: unknown command 'wurst'; known: audit, compare, doctor, eval, explore, "
        "grade, guard, list, record, replay, report, serve, site, sweep, train, wiring\n"
    )
    assert benchmark(["wurst"]) == 2
    known = "known: buffer, crowd, evaluate, guard, guard-alarms, guard-trial, imagine"
    assert known in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "now"),
    [
        (["bench"], "--help"),
        (["bench", "live", "--json", "-"], "live"),
        (["soak", "--minutes", "3"], "soak"),
    ],
)
def test_a_command_that_has_moved_says_where(
    words: list[str], now: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    assert capsys.readouterr().err == (
        f"madviz: {words[0]} has moved: in a clone of the repository, "
        f"run python -m benchmarks {now}\n"
    )


@pytest.mark.parametrize(
    ("found", "end"),
    [
        ("trian", "; did you mean train?"),
        ("PUSH", "; did you mean metaworld/push or maniskill/push-cube?"),
        ("hamer", "; did you mean hammer?"),
        ("push-kube", "; did you mean maniskill/push-cube?"),
        ("wurst", ""),
        ("", ""),
    ],
)
def test_names_like_the_unknown_one_are_suggested_first(found: str, end: str) -> None:
    known = ["maniskill/push-cube", "metaworld/push", "hammer", "train", "eval"]
    assert perhaps(found, known) == end
    everything = "eval, hammer, maniskill/push-cube, metaworld/push, train"
    said = str(unknown("word", found, known))
    assert said == f"unknown word {found!r}{end or ';'} known: {everything}"


def test_a_users_mistake_is_one_line_without_a_traceback() -> None:
    asked = run("eval", "--policy", "no-such-policy")
    assert asked.returncode == 2 and asked.stdout == ""
    assert asked.stderr.startswith("madviz: unknown policy 'no-such-policy'")
    assert "did you mean" not in asked.stderr
    assert asked.stderr.count("\n") == 1


def test_an_unknown_task_lists_the_known_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "--task", "metaworld/wurst", "--out", str(tmp_path / "run")]
    refused(words, "metaworld/hammer", capsys)


def test_missing_opengl_is_one_line_that_points_to_the_doctor(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks", "render", "--rounds", "1"]
    environment = {"MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    asked = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **environment}
    )
    assert asked.returncode == 2 and asked.stdout == ""
    assert "MUJOCO_GL=egl" in asked.stderr and "madviz doctor" in asked.stderr
    assert asked.stderr.count("\n") == 1


def interrupted(config: Any) -> None:
    raise KeyboardInterrupt


def test_ctrl_c_ends_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = replace(cli.COMMANDS["list"], work="tests.test_cli:interrupted")
    monkeypatch.setitem(cli.COMMANDS, "list", command)
    assert cli.main(["list"]) == 130
    assert capsys.readouterr().err == "madviz: stopped\n"


def test_with_a_dash_only_the_json_goes_to_standard_output() -> None:
    program = (
        "import os; from madviz.cli import deliver\n"
        "from madviz.policies.listing import ListConfig\n"
        "def work(config):\n"
        "    print('from Python'); os.system('echo from a child'); os.write(1, b'from C')\n"
        "    return {'a': 1}\n"
        "deliver(ListConfig('-'), work, str)"
    )
    asked = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert json.loads(asked.stdout) == {"a": 1}
    for word in ("from Python", "from a child", "from C"):
        assert word in asked.stderr


def test_a_file_gets_the_json_and_the_terminal_the_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out.json"
    cli.deliver(ListConfig(str(path)), lambda config: {"a": 1}, lambda result: "one a")
    assert json.loads(path.read_text()) == {"a": 1}
    assert capsys.readouterr().out == "one a\n"


def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    worked: list[str] = []
    for place, said in (("missing/out.json", "a folder that exists"), (".", "found a folder")):
        with pytest.raises(UserError, match=f"^--json .*{said}"):
            config = ListConfig(str(tmp_path / place))
            cli.deliver(config, lambda _: {"worked": worked.append("")}, str)
    assert worked == []


def test_the_json_may_go_into_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    words = [sys.executable, "-m", "madviz", "list", "--json", str(pipe)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as running:
        assert "policies" in json.loads(pipe.read_text())
    assert running.returncode == 0 and pipe.is_fifo()


def test_list_has_the_shape_that_is_documented() -> None:
    listed = json.loads(run("list", "--json", "-").stdout)
    assert listed["schema"] == 1 and "metaworld/hammer" in listed["tasks"]
    assert "three" in listed["settings"] and "needs" in listed["methods"]["mad"]
    assert isinstance(listed["policies"], list)


def test_what_was_measured_is_printed_where_it_cannot_be_written(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = ListConfig("/dev/full")
    with pytest.raises(UserError, match="^--json /dev/full could not be written: No space left"):
        cli.deliver(config, lambda _: {"a": 1}, lambda result: "one a")
    assert capsys.readouterr().out == 'one a\n{"a": 1}\n'


@pytest.mark.parametrize("place", ["-", "out.json"])
def test_a_result_is_printed_whatever_else_could_not_be_written(
    place: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def work(config: Any) -> Any:
        with saving({"a": 1}, "--card"):
            Path("/dev/full").write_text("x")

    config = ListConfig("-" if place == "-" else str(tmp_path / place))
    with pytest.raises(UserError, match="^--card could not be written: No space left"):
        cli.deliver(config, work)
    assert json.loads(capfd.readouterr().out) == {"a": 1}
    assert place == "-" or json.loads((tmp_path / place).read_text()) == {"a": 1}


@pytest.mark.parametrize("place", ["", "x" * 300, "ring/out.json", "ring", "/proc/none/x.json"])
def test_a_place_that_takes_no_file_is_refused_before_the_work(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ring").symlink_to("ring")
    with pytest.raises(UserError, match="^--json .*expected") as error:
        cli.deliver(ListConfig(place), lambda _: pytest.fail("worked"), str)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400
    assert [path.name for path in tmp_path.iterdir()] == ["ring"]
