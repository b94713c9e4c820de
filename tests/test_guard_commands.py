"""``madviz guard`` and ``--guard``: fitted beside a policy, and one line where it is not."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from benchmarks.guard_alarms import WAYS, GuardAlarmsConfig, alarms_words, guard_alarms
from benchmarks.guard_trial import GuardTrialConfig, guard_trial, steps_after, trial_words
from madviz.envs.registry import SETTINGS, make_env
from madviz.errors import UserError
from madviz.guard.fit import fit_values
from madviz.guard.policy import GuardedPolicy, GuardReport
from madviz.guard.values import FILE, read_values, write_values
from madviz.measure.audit.audit import AuditConfig, audit_words, command, run_audit
from madviz.measure.compare import CompareConfig, comparison_table, run_compare
from madviz.measure.evaluate import EvalConfig, evaluate, run_eval, success_table
from madviz.measure.guard_fit import GuardConfig, guard_words, play_intact, run_guard
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Occlusion
from madviz.observation.condition import Condition
from madviz.policies.checkpoint import describe, load_policy
from madviz.recording.record import RecordConfig, run_record
from madviz.serving.episodes import BadLook, ServedEpisodes
from madviz.session.replay import finder
from madviz.session.session_file import SavedPolicy
from madviz.subsets import camera_of
from madviz.types import Policy
from tests.checkpoints import saved
from tests.fakes import FakePolicy


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A policy folder with a fitted guard."""
    folder = saved(tmp_path_factory.mktemp("guard"))
    digest = describe(folder).spec.digest
    fitted = run_guard(GuardConfig(str(folder), episodes=4))
    assert fitted["seeds"] == [
        900,
        901,
        902,
        903,
    ] and "4 intact training episodes, 900 to 903." in guard_words(fitted)
    assert describe(folder).spec.digest == digest
    return folder


def test_without_values_one_line_names_the_command(tmp_path) -> None:
    folder = saved(tmp_path)
    with pytest.raises(UserError, match="found none; run `madviz guard --policy "):
        run_eval(EvalConfig(str(folder), guard=True, episodes=1))
    with pytest.raises(UserError, match="GuardedPolicy"):
        load_policy("guard:madviz.examples.own_policy:make")
    with pytest.raises(UserError, match="expected --out FILE"):
        run_guard(GuardConfig("madviz.examples.own_policy:make"))
    with pytest.raises(UserError, match="4 episodes or more"):
        run_guard(GuardConfig(str(folder), episodes=1))


def test_fitted_values_replace_nothing_else(guarded, tmp_path) -> None:
    weights = tmp_path / "weights.safetensors"
    weights.write_bytes(b"weights")
    with pytest.raises(UserError, match="values of a guard, found another file in .*weights"):
        run_guard(GuardConfig(str(guarded), out=weights))
    assert weights.read_bytes() == b"weights"
    older = tmp_path / "older.json"
    older.write_text('{"schema": 1, "streams": {}}')
    assert run_guard(GuardConfig(str(guarded), episodes=4, out=older))["file"] == str(older)
    same = guarded / FILE
    with pytest.raises(UserError, match="--json beside the values"):
        run_guard(GuardConfig(str(guarded), json=str(same)))


def test_black_from_the_first_step_is_as_good_as_dropped(guarded) -> None:
    black = EvalConfig(
        str(guarded), ("all",), episodes=2, workers=0, occlude=("first=black",), guard=True
    )
    result = run_eval(black)
    dropped = evaluate(guarded, ["third_a+third_b"], episodes=2, workers=0)
    returns = [episode["return"] for episode in result["episodes"]]
    assert returns == [episode.total_reward for episode in dropped.episodes]
    assert "left out until it works again" in success_table(result)
    assert result["policy"].endswith("(guarded)")


def test_intact_episodes_are_the_same_with_the_guard(guarded) -> None:
    with_guard = evaluate(f"guard:{guarded}", ["all", "first"], episodes=2, workers=0)
    without = evaluate(guarded, ["all", "first"], episodes=2, workers=0)
    assert with_guard.episodes == without.episodes
    assert with_guard.spec.digest != without.spec.digest
    assert (bool(with_guard.guard), without.guard) == (True, "")


def test_compare_and_record_and_audit_take_it(guarded, tmp_path) -> None:
    words = ("all", "first=black")
    compared = CompareConfig((str(guarded),), conditions=words, guard=True, episodes=2, workers=0)
    assert "left out until it works" in comparison_table(run_compare(compared))
    for name, value in {"guard": True, "episodes": 2, "seed": 7, "workers": 0}.items():
        with pytest.raises(UserError, match=f"expected --conditions beside --{name}"):
            run_compare(replace(CompareConfig((str(guarded),)), **{name: value}))
    own = "madviz.examples.own_policy:make"
    with pytest.raises(UserError, match=f"measured episodes in a folder, found '{own}'"):
        run_compare(CompareConfig((own, str(guarded))))
    out = tmp_path / "film.html"
    recorded = run_record(
        RecordConfig(out, str(guarded), steps=3, drop=("first=black@0",), guard=True)
    )
    assert recorded["policy"].endswith("(guarded)") and out.is_file()
    with pytest.raises(UserError, match="expected --policy beside --guard"):
        run_record(RecordConfig(out, replay=tmp_path, guard=True))
    audit = AuditConfig(
        str(guarded), tmp_path / "audit", episodes=1, how=("black",), workers=0, guard=True
    )
    audited = run_audit(audit)
    assert not audited["policy"].endswith("(guarded)") and "--guard" in command(audit)
    rows = audited.get("guarded")
    assert rows is not None and rows["intact"]["noticed"] == [None]
    assert rows["broken"]["first"]["black"]["noticed"] == [0]
    assert "no false alarm in 1 intact episode" in audit_words(audited)
    page = (tmp_path / "audit" / "audit.md").read_text()
    assert "| guarded | noticed |" in page and "after 1 step (median)" in page
    assert run_audit(audit) == audited, "episodes that were kept answer the same"
    without = run_audit(AuditConfig(str(guarded), tmp_path / "audit", episodes=1, how=("black",)))
    assert "guarded" not in without


def test_served_looks_need_an_episode(guarded) -> None:
    policy = load_policy(f"guard:{guarded}")
    assert isinstance(policy, GuardedPolicy)
    with closing(ServedEpisodes(policy, 6)) as episodes, pytest.raises(BadLook, match="'episode'"):
        episodes.enter({})


def test_a_card_is_of_the_policy_without_a_guard(guarded) -> None:
    with pytest.raises(UserError, match="drop --occlude, --guard or --card"):
        run_eval(EvalConfig(str(guarded), guard=True, card=True))


def test_alarms_of_a_policy_are_counted_and_kept(guarded, tmp_path) -> None:
    config = GuardAlarmsConfig((str(guarded),), tmp_path, episodes=1)
    (found,) = guard_alarms(config)
    assert len(found["noticed"]) == 3 * len(WAYS)
    black = next(row for row in found["noticed"] if row["way"] == "black")
    assert black["steps"] == [0]
    assert "first black: 1 of 1" in alarms_words([found])
    (file,) = tmp_path.glob("*.json")
    file.write_text(json.dumps({**found, "policy": "kept"}))
    assert guard_alarms(config)[0]["policy"] == "kept"
    values = read_values(guarded / FILE, "fit")
    write_values(guarded / FILE, msgspec.structs.replace(values, seeds=(1,)))
    assert guard_alarms(config)[0]["policy"] != "kept", "this is another guard"
    write_values(guarded / FILE, values)


def test_a_saved_episode_finds_its_guard_behind_the_policy_that_was_typed(guarded) -> None:
    find = finder(("madviz.examples.own_policy:make", str(guarded)))  # The first has no guard.
    spec = load_policy(f"guard:{guarded}").spec
    assert find(SavedPolicy.of(spec)).spec == spec
    bare = load_policy(str(guarded)).spec
    assert find(SavedPolicy.of(bare)).spec == bare


def guarded_with(policy: Policy) -> GuardedPolicy:
    """The policy with a guard that is fitted on four of its episodes."""
    spec = policy.spec
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        episodes = [play_intact(policy, env, seed, True) for seed in range(900, 904)]
        places = env.spec.state_numbers.robot
    size = (spec.image_size, spec.image_size)
    return GuardedPolicy(policy, fit_values(episodes, size, places))


def black_from(policy: GuardedPolicy, camera: str, step: int) -> GuardReport:
    """The report on a decision after ``camera`` went black at ``step``."""
    spec = policy.spec
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        stack = stack_of(spec, env.spec)
        now = env.reset(5)
        player = policy.reset(5)
        for number in range(step + 2):
            views = {one.name: env.view(one.name) for one in env.spec.cameras}
            black = {camera: Occlusion("black")} if number >= step else {}
            condition = Condition("all", tuple(black.items()))
            stack.push(views, condition.ablation(spec.streams), 5, number)
            mask = np.ones(len(spec.streams), bool)
            now = env.step(player.act(policy.encode(stack.views, now.state), mask))
    assert player.noticed == step
    return player.report


def test_colour_and_depth_of_a_camera_are_left_out_together() -> None:
    report = black_from(guarded_with(FakePolicy("toy-rgbd", "three-rgbd")), "first", 3)
    left = [camera_of(stream) == "first" for stream in SETTINGS["three-rgbd"].streams]
    assert report.mask.tolist() == [not one for one in left] and sum(left) == 2


def test_the_guard_sees_the_state_that_the_policy_was_given() -> None:
    class Own(FakePolicy):
        """Keeps its state in another form, as a policy that normalises it does."""

        def encode(self, views, state):
            return replace(super().encode(views, state), state=np.zeros(0, np.float32))

    assert black_from(guarded_with(Own()), "first", 3).mask.tolist() == [False, True, True]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:mani_skill")
def test_maniskill_has_a_guard_too(tmp_path) -> None:
    name = "maniskill-push-cube-mad-light"
    out = tmp_path / "guard.json"
    fitted = run_guard(GuardConfig(name, episodes=4, out=out))
    assert fitted["bytes"] < 20_000
    guarded = GuardedPolicy(load_policy(name), read_values(out, "fit"))
    assert black_from(guarded, "first", 2).mask.tolist() == [False, True, True]


def test_an_alarm_before_the_failure_is_not_that_it_was_noticed() -> None:
    assert steps_after(20, [20, 23, 9, None]) == [0, 3, None, None]


@pytest.mark.slow
def test_a_trial_plays_what_is_missing(guarded, tmp_path) -> None:
    config = GuardTrialConfig((str(guarded),), tmp_path, episodes=1, workers=0)
    result = guard_trial(config)
    assert "first black" in trial_words(result)
    assert "no false alarm in 1 intact episode" in trial_words(result)
    assert next(row for row in result["rows"] if row["way"] == "black")["noticed"] == [0]
    assert guard_trial(config) == result
    intact = guard_trial(replace(config, ways=()))["rows"]
    assert intact == [row for row in result["rows"] if not row["camera"]]
