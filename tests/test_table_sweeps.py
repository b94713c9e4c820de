"""The sweep file of a table: every policy of the table is trained again by it, and no other."""

from __future__ import annotations

import json
from pathlib import Path

from madviz.sweep.sweep_plan import read_plan
from tests.evidence import write_policy
from tests.reports import GOOD, report


def test_one_sweep_trains_the_policies_of_a_table_again(tmp_path: Path) -> None:
    """Also where two trainings differ in an option alone."""
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, GOOD, method=method)
    other = write_policy(tmp_path, GOOD, alpha=0.8, folder="other")
    file = other / "config.json"
    config = json.loads(file.read_text())
    config["training"]["command"] += " --light.alpha 0.8 --light.no-standard-state --out x"
    file.write_text(json.dumps(config))
    report(tmp_path)
    overall = read_plan(tmp_path / "sweeps" / "overall.toml")
    assert sorted(run.train[3] for run in overall) == ["mad", "merged-only"]
    assert overall[0].evaluate == ("--episodes", "100", "--seed", "5000")
    plain, changed = sorted(read_plan(tmp_path / "sweeps" / "alpha.toml"), key=lambda r: r.name)
    assert plain.name == "metaworld-hammer-mad-light-alpha0.8-standard-stateFalse-seed1"
    assert changed.name == "metaworld-hammer-mad-light-seed1"


def test_a_sweep_has_every_training_of_its_table(tmp_path: Path) -> None:
    """Hammer was trained once, so that the average has one training of each task."""
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, GOOD, method=method)
        for seed in (1, 2, 3):
            write_policy(
                tmp_path, GOOD, method=method, task="metaworld/push", seed=seed,
                folder=f"{method}-{seed}",
            )  # fmt: skip
    report(tmp_path)
    assert len(read_plan(tmp_path / "sweeps" / "overall.toml")) == 8


def test_a_training_that_was_stopped_is_made_as_long_as_it_got(tmp_path: Path) -> None:
    made = write_policy(tmp_path, GOOD, recipe="paper", steps=90_816)
    file = made / "config.json"
    config = json.loads(file.read_text())
    config["training"] |= {"finished": False}
    config["training"]["command"] += " --paper.steps 150000 --out x"
    file.write_text(json.dumps(config))
    report(tmp_path)
    (run,) = read_plan(tmp_path / "sweeps" / "scratch.toml")
    assert run.train[run.train.index("--paper.steps") + 1] == "90816"
