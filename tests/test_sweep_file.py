"""What the file of a sweep asks for."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.sweep.sweep import SweepConfig, run_sweep
from madviz.sweep.sweep_plan import read_plan
from tests.sweeps import config


def test_a_file_expands_to_runs_whose_names_say_what_varies(tmp_path: Path) -> None:
    file = tmp_path / "alpha.toml"
    file.write_text(
        '[[grid]]\ntasks = ["metaworld/hammer"]\nmethods = ["mad"]\nsettings = ["three-rgbd"]\n'
        "[grid.train]\nlight.alpha = [0.2, 1.0]\nlight.critic_updates = 0\n"
        '[[grid]]\ntasks = ["metaworld/push"]\nmethods = ["merged-only"]\nseeds = [7]\n'
        '[eval]\nepisodes = 9\nseed = 5000\nsubsets = ["all", "first"]\n'
    )
    runs = read_plan(file)
    assert [run.name for run in runs] == [
        "metaworld-hammer-mad-three-rgbd-light-alpha0.2-seed1",
        "metaworld-hammer-mad-three-rgbd-light-alpha1.0-seed1",
        "metaworld-push-merged-only-light-seed7",
    ]
    words = " ".join(runs[0].train)
    assert words == (
        "--task metaworld/hammer --method mad --setting three-rgbd --recipe light --seed 1 "
        "--light.alpha 0.2 --light.critic-updates 0"
    )
    assert runs[2].evaluate == (
        "--episodes",
        "9",
        "--seed",
        "5000",
        "--subsets",
        "all",
        "first",
    )


@pytest.mark.parametrize("command", ["train", "eval"])
def test_the_words_of_a_run_are_words_that_the_command_line_knows(
    command: str, tmp_path: Path
) -> None:

    file = tmp_path / "one.toml"
    file.write_text(
        '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseeds = [4]\n[grid.train]\n'
        'light.rounds = 2\nlight.keep-episodes = true\n[eval]\nsubsets = ["all", "none"]\n'
    )
    run = read_plan(file)[0]
    if command == "train":
        found = cli.parse("train", run.train)
        assert (found.seed, found.light.rounds, found.light.keep_episodes) == (4, 2, True)
    else:
        asked = cli.parse("eval", ["--policy", "p", *run.evaluate, "--card"])
        assert asked.subsets == ("all", "none") and asked.card


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tasks = [", "expected TOML"),
        ("[grids]\n", "unknown word 'grids'; did you mean grid. known: eval, grid"),
        ("", "expected 'grid', found none"),
        ('[grid]\nmethods = ["mad"]\n', "expected 'grid.tasks', found none"),
        (
            '[grid]\ntasks = "toy/reach"\nmethods = ["mad"]\n',
            "expected 'grid.tasks' to be a list, found 'toy/reach'",
        ),
        (
            '[[grid]]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseed = [1]\n',
            r"unknown word in grid\[0\] 'seed'; did you mean seeds\? known: methods, ",
        ),
        ('[grid]\ntasks = []\nmethods = ["mad"]\n', "expected 'grid.tasks' to be a list of"),
        ("[grid]\n[grid]\n", "expected TOML, found: Cannot declare .* twice"),
        (
            '[grid]\ntasks = ["toy/rech"]\nmethods = ["mad"]\n',
            "unknown task 'toy/rech'; did you",
        ),
        ('[grid]\ntasks = ["toy/reach"]\nmethods = ["sad"]\n', "unknown method 'sad'; known"),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseeds = ["1"]\n',
            r"expected 'grid.seeds\[0\]' to be a whole number, found '1'",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[grid.train]\nout = "x"\n',
            "expected other options",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nname = "low"\n'
            "[grid.train]\nlight.alpha = [0.1, 0.2]\n",
            "expected one value for each option of the grid named 'low', found a list for "
            "light.alpha",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[eval]\nepisodes = "many"\n',
            "expected 'eval.episodes' to be a whole number or nothing, found 'many'",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[eval]\nepisodes = 0\n',
            "expected 'eval.episodes' to be a whole number >= 1",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[eval]\nsubsets = []\n',
            "expected 'eval.subsets' to be a list of",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\nseeds = [-1]\n',
            r"expected 'grid.seeds\[0\]' to be a whole number >= 0",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[grid.train]\nlight.alpha = []\n',
            "expected values for light.alpha, found none",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[eval]\nsubsets = ["frist"]\n',
            "unknown camera subset 'frist'; did you mean first",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad", "concat"]\n'
            '[eval]\nsubsets = ["all", "first"]\n',
            r"subsets that concat can act on \(all streams together, and nothing less\), found "
            "'first'",
        ),
        (
            '[grid]\ntasks = ["toy/reach"]\nmethods = ["single"]\n'
            '[grid.train]\ncamera = ["first", "third_a"]\n[eval]\nsubsets = ["all", "first"]\n',
            r"subsets that single can act on \(all, none, rgb, third_a\), found 'first'",
        ),
    ],
)
def test_a_mistake_in_the_file_costs_nothing(text: str, expected: str, tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(UserError, match=expected):
        run_sweep(SweepConfig(str(file), out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_subsets_of_cameras_of_ones_own_are_left_to_the_evaluation(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    grid = '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n[grid.train]\ncameras = "c.toml"\n'
    file.write_text(f'{grid}[eval]\nsubsets = ["all", "left"]\n')
    (run,) = read_plan(file)
    assert run.evaluate[-2:] == ("all", "left")


def test_an_option_counts_for_the_recipe_that_has_it(tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    grid = '[grid]\ntasks = ["toy/reach"]\nmethods = ["mad"]\n'
    file.write_text(f'{grid}recipes = ["light", "paper"]\n[grid.train]\nlight.alpha = [0.2, 0.8]\n')
    light, other, paper = read_plan(file)
    assert [run.name for run in (light, other, paper)] == [
        "toy-reach-mad-light-alpha0.2-seed1",
        "toy-reach-mad-light-alpha0.8-seed1",
        "toy-reach-mad-paper-seed1",
    ]
    assert "--light.alpha" not in paper.train and "--light.alpha" in light.train
    for word, said in (
        ("light.roundz = 20", "unknown option of madviz train 'light.roundz'; did you mean"),
        ("vectorised.steps = 20", "with the recipe paper-vectorised, found light, paper; leave"),
    ):
        file.write_text(f'{grid}recipes = ["light", "paper"]\n[grid.train]\n{word}\n')
        with pytest.raises(UserError, match=said):
            read_plan(file)


def test_a_missing_file_and_no_jobs_at_all_are_mistakes(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a sweep file, found: No such file"):
        run_sweep(SweepConfig(str(tmp_path / "none.toml")))
    with pytest.raises(UserError, match="^--jobs: expected a whole number from 1"):
        run_sweep(config(tmp_path, jobs=0))


RESULTS = Path(__file__).resolve().parent.parent / "results"
PILOTS = RESULTS / "archive" / "pilots"
SHIPPED = [*sorted(RESULTS.glob("sweeps/*.toml")), PILOTS / "pilots.toml"]


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_the_sweeps_that_ship_ask_for_what_exists(file: Path, tmp_path: Path) -> None:
    result = run_sweep(SweepConfig(str(file), out=tmp_path / "out", dry_run=True))
    asked = tomllib.loads(file.read_text())
    assert result["finished"] == 0 and len(result["runs"]) >= len(asked["grid"])
    assert f"madviz sweep {file.relative_to(RESULTS.parent)}" in file.read_text()


def test_a_finished_pilot_is_not_trained_again(tmp_path: Path) -> None:
    shutil.copytree(PILOTS, tmp_path / "out")
    found = run_sweep(SweepConfig(str(PILOTS / "pilots.toml"), out=tmp_path / "out", dry_run=True))
    kept = [folder.name for folder in PILOTS.iterdir() if folder.is_dir()]
    assert all(len(name) <= 60 for name in kept)
    assert found["finished"] == len(kept) >= 1
