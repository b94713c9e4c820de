"""An audit on recordings: changes of the action, intervals over episodes, and its own words."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from madviz.envs.registry import env_spec, make_env
from madviz.errors import UserError
from madviz.measure.audit.audit import AuditConfig, audit_words, run_audit
from madviz.measure.audit.lost_cameras import HOWS
from madviz.measure.audit.recorded import (
    CHANGES,
    OPEN,
    STAYS,
    RecordedAudit,
    distance_row,
    recorded_audit,
    verdict,
)
from madviz.measure.audit.recorded_account import recorded_account
from madviz.measure.formulas import t_interval
from madviz.measure.guard_fit import GuardConfig, guard_words, run_guard
from madviz.measure.mean_picture import mean_pictures
from madviz.policies.checkpoint import load_policy, robot_of_policy
from madviz.policies.guarded import with_guard
from madviz.recorded.known import VARIABLE, allow_recording, recordings_of
from madviz.recorded.robot import robot_of
from madviz.recorded.scaling import Scaling
from madviz.recording.record import RecordConfig, run_record
from madviz.serving.dry_run import dry_run
from madviz.serving.serve import PolicyServer
from madviz.training.config import TrainConfig
from madviz.training.light_options import LightConfig
from madviz.training.train import train
from madviz.types import Array, Encoded, PolicySpec, Readout
from madviz.wire.wiring import Wiring, checked
from tests.recordings import TOP, Small, level, png

FEW = LightConfig(rounds=1, updates_per_round=1, batch_size=4, hidden_dim=16)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of 20 episodes, of which two are held out."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    return Small(episodes=20, films=False).write(tmp_path / "bench")


@dataclass
class Looks:
    """Its action is as bright as the newest picture of ``top``; ``wrist`` it never looks at."""

    spec: PolicySpec
    droppable: bool = True

    def encode(self, views: Array, state: Array) -> Encoded:
        bright = views[:, -3:].mean((1, 2, 3)) / 255  # (V,)
        return Encoded(bright[:, None].astype(np.float32), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        seen = np.where(masks[:, 0], encoded.features[0, 0], 0)  # (N,)
        action = np.repeat(seen[:, None], 3, axis=1).astype(np.float32)
        return Readout(seen[:, None], action, np.full(len(masks), np.nan))

    def supports(self, mask: Array) -> bool:
        return self.droppable or bool(mask.all())


def audit_of(bench: Path, droppable: bool = True) -> RecordedAudit:
    task = allow_recording(bench)
    found = recordings_of(task)
    spec = PolicySpec("looks", task, "own", "three", "own", ("top", "wrist"), ("all",))
    return RecordedAudit(Looks(spec, droppable), robot_of(found), found, env_spec(task), HOWS)


def test_a_camera_that_is_not_looked_at_hardly_changes_the_action(bench: Path) -> None:
    audit = audit_of(bench)
    one = frozenset({audit.recordings.digest(0)})
    audit = replace(audit, robot=replace(audit.robot, trained_on=one))
    found = recorded_audit(audit)
    assert found["episodes"] == found["judged"] == list(range(1, 20)) and found["training_known"]
    assert found["label"] == "recorded: actions change nothing"
    assert found["verdict"] == {"top": CHANGES, "wrist": STAYS}
    rows = {(row["camera"], row["what"], row["how"]): row for row in found["conditions"]}
    assert len(rows) == 25
    assert rows["wrist", "removed", "noise"]["change"]["mean"] == 0
    # Bright pictures of ``top`` once more, from the files, in float64.
    changes, errors = [], []
    robot, recordings = audit.robot, audit.recordings
    unit = (np.array(robot.actions.high) - np.array(robot.actions.low)) / 2 / np.array(robot.spread)
    for index in range(1, 20):
        bright = recordings.frames(index, 84)[:, 0].astype(np.float64).mean((1, 2, 3)) / 255  # (T,)
        changes.append(np.sqrt(((bright[:, None] * unit) ** 2).mean(1)).mean())
        scaled = robot.actions.scale(recordings.numbers(index)[1])
        errors.append(np.sqrt((((bright[:, None] - scaled) * unit) ** 2).mean(1)).mean())
    top = rows["top", "removed", "dropped"]["change"]
    assert top["mean"] == pytest.approx(np.mean(changes), rel=1e-4)
    assert top["ci95"] == pytest.approx(list(t_interval(np.array(changes))), rel=1e-4)
    assert found["apart"]["mean"] == pytest.approx(np.mean(errors), rel=1e-4)
    moment = found["moments"][0]
    assert (moment["camera"], moment["step"]) == ("top", 5)  # Pictures get brighter.
    assert moment["place"] == moment["episode"]


def test_a_policy_that_samples_is_judged_by_what_goes_beyond(bench: Path) -> None:
    audit = audit_of(bench)
    one = frozenset({audit.recordings.digest(0)})
    audit = replace(audit, robot=replace(audit.robot, trained_on=one))  # 19 episodes are judged.
    spec = audit.policy.spec

    class Samples(Looks):
        """Adds noise to ``share`` of what ``Looks`` answers."""

        def __init__(self, share: float, spread: float) -> None:
            super().__init__(spec, True)
            self.share = share
            self.spread = spread
            self.rng = np.random.default_rng(0)

        def encode(self, views: Array, state: Array) -> Encoded:
            return replace(super().encode(views, state), private={})

        def read(self, encoded: Encoded, masks: Array) -> Readout:
            """It keeps its answer to a mask with what was encoded, as a served policy does."""
            read = super().read(encoded, masks)
            drawn = self.rng.normal(0, self.spread, read.action.shape)
            noise = [
                encoded.private.setdefault(mask.tobytes(), one)
                for mask, one in zip(masks, drawn, strict=True)
            ]
            return replace(read, action=(self.share * read.action + noise).astype(np.float32))

    alone = recorded_audit(replace(audit, policy=Samples(0, 0.2)))
    assert alone["repeats"]["mean"] > 0.1
    assert alone["verdict"] == {"top": OPEN, "wrist": OPEN}, "noise is no use of a camera"
    both = recorded_audit(replace(audit, policy=Samples(1, 0.1)))
    assert both["verdict"] == {"top": CHANGES, "wrist": OPEN}
    little = recorded_audit(replace(audit, policy=Samples(1, 0.02)))
    assert 0 < little["repeats"]["mean"] < 0.1
    assert little["verdict"] == {"top": CHANGES, "wrist": STAYS}
    assert any(line.startswith("Asked the same twice, it answers ") for line in words_of(both))
    assert recorded_audit(audit)["repeats"]["mean"] == 0
    assert not any(line.startswith("Asked") for line in words_of(recorded_audit(audit)))


def test_a_policy_that_cannot_drop_is_judged_by_the_mean_picture(bench: Path) -> None:
    found = recorded_audit(audit_of(bench, droppable=False))
    assert set(found["decided_by"].values()) == {"mean"}


def test_no_distance_rests_on_an_episode_of_training(bench: Path) -> None:
    audit = audit_of(bench)
    alone, more = recorded_audit(audit), recorded_audit(audit, most=4)
    assert more["episodes"] == [9, 19, 0, 1] and more["judged"] == [9, 19]
    assert more["conditions"] == alone["conditions"] and more["verdict"] == alone["verdict"]
    assert any("was trained on 2 episodes more" in line for line in words_of(more))
    knows_all = frozenset(map(audit.recordings.digest, range(20)))
    known = recorded_audit(replace(audit, robot=replace(audit.robot, trained_on=knows_all)))
    assert set(known["verdict"].values()) == {OPEN} and len(known["episodes"]) == 20
    assert any("was trained on all of these episodes" in line for line in words_of(known))


def test_where_training_is_not_known_verdicts_rest_on_what_would_be_held_out(bench: Path) -> None:
    audit = audit_of(bench)
    older = replace(audit, robot=replace(audit.robot, trained_on=frozenset()))
    found = recorded_audit(older, most=4)
    assert found["judged"] == [9, 19] and not found["training_known"]
    assert found["verdict"] == recorded_audit(audit)["verdict"]
    lines = words_of(found)
    assert any(line.startswith("It is not known what the policy was trained on") for line in lines)
    assert any("may have been trained on 2 episodes more" in line for line in lines)


def test_answers_that_are_not_finite_are_named_and_left_out(bench: Path) -> None:
    audit = audit_of(bench)

    class Nan(Looks):
        def read(self, encoded: Encoded, masks: Array) -> Readout:
            found = super().read(encoded, masks)
            return replace(found, action=np.full_like(found.action, np.nan))

    with pytest.raises(UserError, match="episode 19: expected finite actions"):
        recorded_audit(replace(audit, policy=Nan(audit.policy.spec)))
    still = replace(audit.robot, actions=Scaling((0.0,) * 3, (0.0,) * 3))
    with pytest.raises(UserError, match="expected actions that change"):
        recorded_audit(replace(audit, robot=still))


def test_episodes_with_a_broken_picture_are_named_and_left_out(bench: Path, tmp_path: Path) -> None:
    """``bench`` sets the cache."""
    small = Small(episodes=20, films=False)
    for episode in (0, 9):  # One of training, one held out.
        small.rows[TOP][6 * episode + 1] = {"bytes": b"no picture", "path": None}
    small.rows[TOP][6 * 4] = {"bytes": png(np.zeros((48, 64, 3), np.uint8)), "path": None}
    folder = small.write(tmp_path / "broken")
    audit = audit_of(folder)
    document = recorded_audit(audit)
    assert document["episodes"] == [19]
    assert [line[:11] for line in document["left_out"]] == ["episode 0: ", "episode 9: "]
    lines = dry_run(audit.policy, audit.robot, folder)
    assert "episode 19 of broken (the policy was not trained on it)" in lines[0]
    assert lines[-2].startswith("left out: episode 9: ") and "no robot moved" in lines[-1]
    own = GuardConfig("tests.recorded_policy:make", out=tmp_path / "own.json", recording=folder)
    fitted = run_guard(own)
    assert fitted["seeds"] == [1, 2, 3, 4, 5, 6, 7, 8, 10, 11, 12, 13]
    blank = "Left out: top: 1 even or dark picture, the first at step 0 of episode 4"
    assert guard_words(fitted).endswith(blank) and "Left out: episode 0: " in guard_words(fitted)


def test_a_policy_gets_the_mean_picture_of_training_episodes_alone(bench: Path) -> None:
    found = mean_pictures(env_spec(allow_recording(bench)), ("wrist", "top"))
    chosen = [0, 2, 4, 6, 8, 11, 13, 15, 17]  # Every second one that is not held out.
    expected = np.mean([level(episode, step) for episode in chosen for step in range(6)])
    assert list(found) == ["wrist", "top"]
    assert np.abs(found["top"][30:54, 10:40] - expected).max() <= 1


def test_one_of_two_cameras_alone_is_the_other_one_removed(bench: Path) -> None:
    found = recorded_audit(audit_of(bench))
    (table,) = [
        block for block in recorded_account(found, "again", []) if block.lines[:1] == ("cameras",)
    ]
    assert table.lines[-1] == "further off", "as *How to read this* calls it"
    labels = [row[0] for row in table.rows]
    assert labels[:3] == ["Top removed, Wrist alone", "Wrist removed, Top alone", "no camera"]
    assert len(labels) == 15


def test_episodes_of_other_recordings_are_new_to_the_policy(bench: Path, tmp_path: Path) -> None:
    audit = audit_of(bench)
    other = Small(episodes=3, films=False)
    other.states += 0.1
    other.rows["observation.state"] = list(other.states)
    recordings = recordings_of(allow_recording(other.write(tmp_path / "other")))
    assert replace(audit, recordings=recordings).chosen(None) == [0, 1, 2]
    nobody_knows = replace(audit.robot, trained_on=frozenset())
    assert replace(audit, robot=nobody_knows).chosen(3) == [9, 19, 0]


def test_the_number_that_changes_most_is_named(bench: Path) -> None:
    audit = audit_of(bench)
    found = recorded_audit(audit)
    top = next(row for row in found["conditions"] if row["camera"] == "top")
    unit = np.array(audit.robot.actions.high) - np.array(audit.robot.actions.low)
    most = int((unit / np.array(audit.robot.spread)).argmax())  # All numbers move alike.
    assert top["most"] == audit.robot.action_names[most]
    assert (
        f"most of all {top['most']} ({top['most_apart']:.2f} of its own spread)"
        in words_of(found)[1]
    )
    still = replace(audit.robot, actions=Scaling((0.0,) * 3, (0.0, 2.0, 0.0)), spread=(1.0,) * 3)
    apart = still.distance(np.zeros(3), np.array([np.nan, 0.5, 5.0]))
    assert apart == pytest.approx(0.5), "numbers that never change count for nothing"
    assert np.isnan(still.distance(np.zeros(3), np.array([0.0, np.nan, 0.0])))


def words_of(found) -> list[str]:
    return audit_words(found).splitlines()


@pytest.mark.parametrize(
    ("values", "expected"),
    [([0.3, 0.4, 0.35], CHANGES), ([0.01, 0.02], STAYS), ([0.0, 0.3, 0.1], OPEN), ([0.5], OPEN)],
)
def test_verdicts_follow_their_interval(values: list[float], expected: str) -> None:
    assert verdict(distance_row(values)) == expected


def test_the_interval_is_students() -> None:
    low, high = t_interval(np.array([1.0, 2.0, 4.0]))
    # t(0.975, 2) = 4.30265, and the deviation 1.52753.
    assert low == pytest.approx(7 / 3 - 4.30265 * 1.52753 / 3**0.5, abs=1e-4)
    assert high == pytest.approx(7 / 3 + 4.30265 * 1.52753 / 3**0.5, abs=1e-4)


def test_the_command_writes_a_page_that_never_says_success(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(TrainConfig(recording=bench, out=tmp_path / "mad", light=FEW), lambda _: None)
    config = AuditConfig(str(tmp_path / "mad"), tmp_path / "a", recording=bench, how=("dropped",))
    found = run_audit(config)
    assert "label" in found
    for ending in ("html", "md", "json"):
        text = (tmp_path / f"a/audit.{ending}").read_text().lower()
        assert "recorded: actions change nothing" in text
        assert not any(word in text for word in ("success", "redundant", str(tmp_path)))
    page = (tmp_path / "a/audit.html").read_text()
    command = "madviz explore --recording bench --policy mad --seed 9 --condition top=off"
    assert command in page
    assert "2 episodes are few" in audit_words(found).lower()
    other = Small(episodes=20, films=False)
    other.rows["action"] = [0.9 * one for one in other.rows["action"]]
    tuesday = other.write(tmp_path / "tuesday" / "bench")
    monkeypatch.setenv(VARIABLE, "")
    with pytest.raises(UserError, match="expected the recordings bench .* choose another folder"):
        run_audit(replace(config, recording=tuesday))
    assert (tmp_path / "a/audit.html").read_text() == page
    with pytest.raises(UserError, match="without --along, --guard and --task"):
        run_audit(AuditConfig(str(tmp_path / "mad"), tmp_path / "b", recording=bench, guard=True))


@pytest.mark.parametrize(
    "words",
    [{"cameras": {"top.rgb": "t"}}, {"cameras": {"top": "t"}, "modality": "depth"}],
)
def test_a_wire_file_asks_recordings_for_colour_alone(bench: Path, words: dict[str, Any]) -> None:
    table = {"task": allow_recording(bench), "size": 24, "letterbox": True, "state": "s"}
    with pytest.raises(UserError, match="recordings have colour only, found 'top"):
        checked(msgspec.convert({**table, "masks": True, **words}, Wiring), "here")


def test_a_policy_of_a_simulator_is_refused(bench: Path, tmp_path: Path) -> None:
    config = AuditConfig("metaworld-hammer-mad-light", tmp_path / "a", recording=bench)
    with pytest.raises(UserError, match="expected a policy for recording/bench"):
        run_audit(config)


def test_a_guard_is_fitted_on_training_episodes_of_recordings(bench: Path, tmp_path: Path) -> None:
    train(TrainConfig(recording=bench, out=tmp_path / "mad", light=FEW), lambda _: None)
    policy = str(tmp_path / "mad")
    fitted = run_guard(GuardConfig(policy, episodes=20, recording=bench))
    assert fitted["seeds"] == [number for number in range(20) if number % 10 != 9]
    assert "18 intact training episodes, 0 to 8, 10 to 18." in guard_words(fitted)
    with pytest.raises(UserError, match="expected a policy of recording/bench, found"):
        run_guard(GuardConfig("metaworld-hammer-mad-light", recording=bench))
    own = GuardConfig("tests.recorded_policy:make", out=tmp_path / "own.json", recording=bench)
    assert run_guard(own)["seeds"] == fitted["seeds"][:12], "a policy without a robot.json"
    # Recordings that are known by the environment variable alone are the same.
    assert run_guard(GuardConfig(policy, episodes=20))["seeds"] == fitted["seeds"]
    guarded = load_policy(with_guard(policy, True))
    lines = dry_run(guarded, robot_of_policy(policy), bench)
    assert "no robot moved" in lines[-1]


@pytest.mark.slow
def test_from_our_own_export_to_a_dry_run_with_a_guard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Record, train, explore's environment, audit of the folder and over the wire, guard, dry
    run."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(VARIABLE, "")
    dataset = tmp_path / "exported"
    run_record(RecordConfig(dataset, format="lerobot", expert="metaworld/hammer", episodes=6))
    policy = str(tmp_path / "mad")
    light = LightConfig(rounds=1, updates_per_round=3, batch_size=16, hidden_dim=64)
    train(TrainConfig(recording=dataset, out=Path(policy), light=light), lambda _: None)
    with closing(make_env("recording/exported")) as env:
        first = env.reset(5)
        assert env.spec.recorded and np.abs(first.state).max() < 1.5
    folder = run_audit(AuditConfig(policy, tmp_path / "a", recording=dataset, how=("dropped",)))
    server = PolicyServer(load_policy(policy), robot=robot_of_policy(policy)).start()
    try:
        config = AuditConfig(server.address, tmp_path / "b", recording=dataset, how=("dropped",))
        served = run_audit(config)
    finally:
        server.close()
    assert "label" in folder and "label" in served
    for here, there in zip(folder["conditions"], served["conditions"], strict=True):
        assert here["change"]["mean"] == pytest.approx(there["change"]["mean"], abs=1e-3)
    run_guard(GuardConfig(policy, recording=dataset))
    lines = dry_run(load_policy(with_guard(policy, True)), robot_of_policy(policy), dataset)
    assert "no robot moved" in lines[-1]
