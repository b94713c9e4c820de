"""Episodes, worker processes and the commands around them. Processes are real, the world is toy."""

import json
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch

from madviz.agent.agent import Agent
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import Unfinished, UserError
from madviz.measure.episodes import Job, Runner, run_episode
from madviz.measure.evaluate import (
    EvalConfig,
    default_subsets,
    evaluate,
    run_eval,
)
from madviz.measure.store import MEMORY, Store
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_condition, parse_occlusions
from madviz.policies import checkpoint
from madviz.policies.config import TrainingRecord, policy_config
from madviz.types import PolicySpec
from tests.fakes import AllOrNothing, FakePolicy, NanPolicy

STREAMS = SETTINGS["three"].streams
ALL, FIRST, NONE = (np.array(mask, bool) for mask in ((1, 1, 1), (1, 0, 0), (0, 0, 0)))
INTACT = Ablation()
NOISY = Condition("all", (("first", Occlusion("noise")),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A torch policy that nobody trained, in a folder."""
    torch.manual_seed(0)
    networks = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8)
    spec = PolicySpec("toy", "toy/reach", "mad", "three", "light", STREAMS, ("all", *STREAMS))
    config = policy_config(spec, ToyReach().spec, networks, TrainingRecord(command="madviz train"))
    return checkpoint.save_policy(tmp_path_factory.mktemp("toy"), Agent(networks), config)


class Expert(FakePolicy):
    """Reads the answer out of its environment; needs ``first`` to be present."""

    def __init__(self, env):
        super().__init__("expert")
        self.env = env

    def read(self, encoded, masks):
        readout = super().read(encoded, masks)
        return replace(readout, action=np.array([self.env.expert() * m[0] for m in masks]))


class CountingEnv(ToyReach):
    """Remembers which cameras were drawn."""

    def __init__(self):
        super().__init__()
        self.drawn = []

    def view(self, camera, size=None):
        self.drawn.append(camera)
        return super().view(camera, size)


def make_nan_policy():
    return NanPolicy()


def jobs_for(count, subset="all"):
    policy = "tests.fakes:FakePolicy"
    return [Job(policy, "toy-mad0", Condition(subset), seed) for seed in range(5000, 5000 + count)]


# --- One episode ---


def test_success_is_counted_at_the_last_step_and_at_any():
    env = ToyReach()
    result = run_episode(Expert(env), env, ALL, INTACT, 5000)
    assert (result.success, result.success_any, result.subset, result.seed) == (1, 1, "all", 5000)
    assert result.total_reward > 10

    class Watched(ToyReach):
        def step(self, action):
            self.now = super().step(action)
            return self.now

        def reset(self, seed):
            self.now = super().reset(seed)
            return self.now

    class Leaves(Expert):
        def read(self, encoded, masks):
            readout = super().read(encoded, masks)
            return replace(readout, action=-readout.action) if watched.now.success else readout

    watched = Watched()
    wanders = [run_episode(Leaves(watched), watched, ALL, INTACT, seed) for seed in range(20)]
    assert any(r.success_any and not r.success for r in wanders)


def test_only_cameras_that_are_present_are_drawn():
    for mask, expected in ((ALL, set(STREAMS)), (FIRST, {"first"}), (NONE, set())):
        env = CountingEnv()
        run_episode(FakePolicy(), env, mask, INTACT, 1)
        assert set(env.drawn) == expected
        assert len(env.drawn) == env.spec.horizon * len(expected)


@pytest.mark.parametrize("failing", ["first=freeze@5", "first=off@5"])
def test_a_failure_can_begin_in_mid_episode(failing, monkeypatch):
    env = CountingEnv()
    monkeypatch.setattr("madviz.measure.episodes.make_env", lambda *_: env)
    runner = Runner()
    runner.adopt("fake", policy := FakePolicy())

    def played(word):
        env.drawn.clear()
        pictures, actions = [], []

        def watch(env, stack, encoded, action):
            pictures.append(stack.newest["first"])
            actions.append(action)

        condition = parse_condition(word, STREAMS).noticed(STREAMS)
        finished = runner.run(Job("fake", policy.spec.digest, condition, 7), watch)
        return finished, pictures, np.array(actions), env.drawn.count("first")

    (_, pictures, actions, drawn), (_, intact, intended, _) = played(failing), played("all")
    assert drawn == 5 and np.array_equal(pictures[:5], intact[:5])
    assert np.array_equal(actions[:5], intended[:5]) and (actions[5:] != intended[5:]).any()
    last = pictures[4] if "freeze" in failing else np.zeros_like(pictures[0])
    assert (np.array(pictures[5:]) == last).all()
    assert played(f"{failing[:-1]}0")[0] == played(failing[:-2])[0]
    with pytest.raises(
        UserError, match="before step 25, where toy/reach ends, found one at step 25"
    ):
        played(f"{failing[:-1]}25")


def test_what_was_not_drawn_makes_no_difference():
    class DrawsAll(FakePolicy):
        """Sees every camera, whatever the mask: its streams come straight from the world."""

        def encode(self, views, state):
            frames = [env.view(camera).rgb.transpose(2, 0, 1) for camera in STREAMS]
            views = views.copy()
            views[:, -3:] = frames
            return super().encode(views, state)

    env = ToyReach()
    drawn = run_episode(DrawsAll(), env, FIRST, INTACT, 7)
    assert drawn == run_episode(FakePolicy(), env, FIRST, INTACT, 7)


def test_an_episode_does_not_depend_on_what_ran_before():
    env, policy = ToyReach(), FakePolicy()
    noisy = NOISY.ablation(STREAMS)
    fresh = run_episode(policy, ToyReach(), ALL, noisy, 3)
    run_episode(policy, env, FIRST, INTACT, 4)
    assert run_episode(policy, env, ALL, noisy, 3) == fresh
    assert run_episode(policy, env, ALL, noisy, 4) != replace(fresh, seed=4)


def test_an_occlusion_is_not_a_drop():
    env, policy = ToyReach(), FakePolicy()
    black = NOISY.ablation(STREAMS)
    dropped = run_episode(policy, env, np.array([0, 1, 1], bool), INTACT, 3)
    rewards = {run_episode(policy, env, ALL, a, 3).total_reward for a in (INTACT, black)}
    assert len(rewards | {dropped.total_reward}) == 3


def test_a_subset_the_policy_cannot_act_on_is_an_error():
    with pytest.raises(UserError, match="picky cannot act on 'first'; it was trained on: all"):
        run_episode(AllOrNothing("picky"), ToyReach(), FIRST, INTACT, 1)


def test_relevant_occlusions_are_those_a_policy_can_notice():
    black, noise = Occlusion("black"), Occlusion("noise")
    occlusions = (("third_a", noise), ("first", black), ("third_b", Occlusion("none")))

    def noticed(subset, occlusions=occlusions):
        return Condition(subset, occlusions).noticed(STREAMS).occlusions

    assert noticed("all") == (("first", black), ("third_a", noise))
    assert noticed("first") == (("first", black),)
    assert noticed("none") == ()
    assert noticed("all", (("fourth", black),)) == ()  # Another policy has that camera.


# --- Evaluations ---


def test_results_are_the_same_bits_with_any_number_of_workers(folder):
    asked = {"subsets": ("all", "first+third_b", "none"), "episodes": 3, "seed": 7}
    serial = evaluate(folder, **asked, workers=0)
    assert len({e.total_reward for e in serial.episodes}) > 3
    assert evaluate(folder, **asked, workers=2) == serial
    alone = [evaluate(folder, ("none",), episodes=1, seed=s, workers=0) for s in (9, 8, 7)]
    assert tuple(a.episodes[0] for a in alone[::-1]) == serial.episodes[6:]


def test_every_subset_sees_the_same_seeds_in_order():
    found = evaluate(FakePolicy(), ("first", "all"), episodes=4, seed=11)
    assert [(e.subset, e.seed) for e in found.episodes] == [
        (subset, seed) for subset in ("first", "all") for seed in (11, 12, 13, 14)
    ]
    assert list(found.outcomes("all")) == [11, 12, 13, 14]


def test_the_document_has_the_schema(folder):
    document = evaluate(folder, ("all", "first+third_a"), episodes=3, workers=0).to_json()
    assert document["schema"] == 1 and document["policy"] == "toy" and document["seed"] == 60_000
    assert document["task"] == "toy/reach" and document["definition"].startswith("at the last step")
    assert set(document["subsets"]) == {"all", "first+third_a"}
    for name, row in document["subsets"].items():
        assert set(row) == {"success", "success_any", "n", "ci95", "trained", "outside"}
        assert row["n"] == 3 and row["trained"] == (name == "all")
        assert 0 <= row["ci95"][0] <= row["success"] <= row["ci95"][1] <= 1
    assert len(document["episodes"]) == 6
    for episode in document["episodes"]:
        assert set(episode) == {"subset", "seed", "success", "success_any", "return"}
    assert json.loads(json.dumps(document)) == document


def test_subsets_are_reported_in_one_spelling_and_once():
    found = evaluate(FakePolicy(), ("third_b+first", "first+third_b", "rgb"), episodes=1)
    assert list(found.rows) == ["first+third_b", "all"]


def spec_with(streams, trained):
    names = ("p", "toy/reach", "mad", "three", "light")
    return PolicySpec(*names, streams=streams, trained_subsets=trained)


def test_default_subsets_show_what_was_trained_every_single_stream_and_the_floor():
    rgb = spec_with(STREAMS, ("all",))
    assert default_subsets(rgb) == ("all", "first", "third_a", "third_b", "none")
    streams = SETTINGS["three-rgbd"].streams
    both = default_subsets(spec_with(streams, ("all", "rgb", "depth", "first", "first.rgb")))
    assert both[:5] == ("all", "rgb", "depth", "first", "first.rgb")
    assert set(streams) < set(both) and both[-1] == "none" and len(set(both)) == len(both)


def test_default_subsets_leave_out_what_the_policy_cannot_do(capsys):
    assert list(evaluate(AllOrNothing(), episodes=1).rows) == ["all"]
    assert "cannot act on first, third_a, third_b, none: left out" in capsys.readouterr().err
    with pytest.raises(UserError, match="cannot act on 'first'"):
        evaluate(AllOrNothing(), ("first",), episodes=1)


def test_occlusions_are_part_of_the_result():
    occlusions = {"first": Occlusion("black")}
    found = evaluate(FakePolicy(), ("all", "third_a"), episodes=1, occlusions=occlusions)
    intact = evaluate(FakePolicy(), ("all", "third_a"), episodes=1)
    assert found.occlusions.startswith("first:black") and intact.occlusions == ""
    changed = [a != b for a, b in zip(found.episodes, intact.episodes, strict=True)]
    assert changed == [True, False]


def test_the_store_answers_only_when_it_is_handed_in(folder, monkeypatch):
    store, ran = Store(MEMORY), []
    run = Runner.run
    monkeypatch.setattr(Runner, "run", lambda self, job: ran.append(job.seed) or run(self, job))
    first = evaluate(folder, ("all",), episodes=2, workers=0, store=store)
    assert ran == [60_000, 60_001]
    again = evaluate(folder, ("all",), episodes=3, workers=0, store=store)
    assert ran == [60_000, 60_001, 60_002] and again.episodes[:2] == first.episodes
    evaluate(folder, ("all",), episodes=2, workers=0)
    assert ran == [60_000, 60_001, 60_002, 60_000, 60_001]
    evaluate(
        folder,
        ("all",),
        episodes=1,
        workers=0,
        store=store,
        occlusions=parse_occlusions(["first=black"]),
    )
    assert len(ran) == 6


def test_bring_your_own_is_never_stored(tmp_path):
    store = Store(tmp_path / "results.sqlite")
    evaluate("tests.fakes:FakePolicy", ("all",), episodes=1, workers=0, store=store)
    store.close()
    with closing(sqlite3.connect(tmp_path / "results.sqlite")) as db:
        assert db.execute("SELECT count(*) FROM episodes_2").fetchone() == (0,)


@pytest.mark.parametrize("asked", [{"episodes": 0}, {"seed": -1}, {"workers": -1}])
def test_impossible_numbers(folder, asked):
    with pytest.raises(UserError, match="expected"):
        evaluate(folder, ("all",), **{"episodes": 1, **asked})


def test_unknown_names():
    with pytest.raises(UserError, match="unknown camera subset 'fourth'; known: all"):
        evaluate(FakePolicy(), ("first+fourth",), episodes=1)
    with pytest.raises(UserError, match="unknown policy 'nope'"):
        evaluate("nope", episodes=1)
    with pytest.raises(UserError, match="unknown camera to occlude 'fourth'; known: first"):
        evaluate(FakePolicy(), ("all",), episodes=1, occlusions={"fourth": Occlusion("black")})


def test_a_policy_trained_elsewhere_is_refused(folder, tmp_path):
    config = json.loads((folder / "config.json").read_text())
    config["cameras"][0]["fovy"] += 1
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "weights.safetensors").write_bytes((folder / "weights.safetensors").read_bytes())
    with pytest.raises(UserError, match="no others; found 'first' placed elsewhere"):
        evaluate(tmp_path, ("all",), episodes=1, workers=0)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_mistake_in_a_worker_reaches_the_user(workers):
    with pytest.raises(UserError, match="expected a finite action"):
        evaluate("tests.test_evaluate:make_nan_policy", ("first",), episodes=2, workers=workers)


class Fails(FakePolicy):
    """Raises what no policy should, in its third episode of 25 decisions."""

    def __init__(self) -> None:
        super().__init__()
        self.left = 60

    def encode(self, views, state):
        self.left -= 1
        if not self.left:
            raise RuntimeError("out of memory")
        return super().encode(views, state)


def test_what_was_played_is_kept_whatever_a_policy_raises():
    with pytest.raises(Unfinished, match="RuntimeError: out of memory; 2 of 4 episodes") as stopped:
        evaluate(Fails(), ("all",), episodes=4, workers=0)
    assert len(stopped.value.result.episodes) == 2


# --- The command ---


def test_rates_on_other_seeds_stay_when_reporting_seeds_are_read(folder, tmp_path, capsys):
    copy = tmp_path / "toy"
    shutil.copytree(folder, copy)
    (copy / "evaluation.json").unlink(missing_ok=True)

    def firsts(name):
        file = copy / f"{name}.json"
        return json.loads(file.read_text())["seed"] if file.exists() else None

    for seed in (70_000, 40_000):
        run_eval(EvalConfig(str(copy), ("all",), episodes=1, seed=seed, workers=0, card=True))
    assert (firsts("evaluation"), firsts("development")) == (40_000, 70_000)
    (copy / "evaluation.json").unlink()
    for seed in (10_000, 40_000):
        run_eval(EvalConfig(str(copy), ("all",), episodes=1, seed=seed, workers=0, card=True))
    assert (firsts("evaluation"), firsts("development")) == (40_000, 70_000)
    assert "rates on development (read) seeds give way" in capsys.readouterr().err


def test_eval_command_computes_and_writes_the_card(folder, tmp_path, capsys):
    copy = tmp_path / "toy"
    shutil.copytree(folder, copy)
    (copy / "evaluation.json").write_text('{"digest": "of others", "subsets": {}}')
    config = EvalConfig(str(copy), ("all", "first"), episodes=2, seed=5, workers=0, card=True)
    document = run_eval(config)
    assert document == evaluate(folder, ("all", "first"), episodes=2, seed=5, workers=0).to_json()
    assert json.loads((copy / "evaluation.json").read_text()) == document
    assert "| first |" in (copy / "card.md").read_text()
    assert capsys.readouterr().out == ""


def test_a_card_can_be_filled_in_several_goes(folder, tmp_path, capsys):
    copy = tmp_path / "toy"
    shutil.copytree(folder, copy)
    (copy / "evaluation.json").unlink(missing_ok=True)
    for subsets, seed in ((("all", "first"), 5), (("first", "none"), 5)):
        run_eval(EvalConfig(str(copy), subsets, episodes=2, seed=seed, workers=0, card=True))
    together = json.loads((copy / "evaluation.json").read_text())
    assert set(together["subsets"]) == {"all", "first", "none"}
    assert sorted(e["subset"] for e in together["episodes"]) == sorted(["all", "first", "none"] * 2)
    run_eval(EvalConfig(str(copy), ("all",), episodes=2, seed=6, workers=0, card=True))
    assert set(json.loads((copy / "evaluation.json").read_text())["subsets"]) == {"all"}
    said = "evaluation.json: its 6 episodes from seed 5 on give way to 2 from 6 on\n"
    heard = capsys.readouterr().err
    assert said in heard and heard.count("give way") == 1


def test_a_card_is_not_written_about_occluded_cameras_or_somebodys_own_code(folder):
    for config in (
        EvalConfig(str(folder), occlude=("first=black",), card=True),
        EvalConfig("tests.fakes:FakePolicy", card=True),
    ):
        with pytest.raises(UserError, match="drop --occlude, --guard or --card"):
            run_eval(config)


def test_the_public_name_is_callable_before_and_after_its_module_is_imported():
    code = "import madviz; from madviz.{} import *; madviz.evaluate('nope')"
    for first in ("types", "measure.evaluate"):
        found = subprocess.run(
            [sys.executable, "-c", code.format(first)], capture_output=True, text=True, timeout=60
        )
        assert "UserError: unknown policy 'nope'" in found.stderr


def test_a_process_keeps_a_few_policies_and_notices_a_changed_one(folder, tmp_path, monkeypatch):
    loaded, load = [], checkpoint.load_policy
    monkeypatch.setattr(checkpoint, "load_policy", lambda p: loaded.append(p) or load(p))
    runner, digest = Runner(), checkpoint.describe(folder).spec.digest
    for policy in (str(folder), "tests.fakes:FakePolicy") * 2:
        runner.run(
            Job(policy, digest if policy == str(folder) else "toy-mad0", Condition("none"), 1)
        )
    assert loaded == [str(folder), "tests.fakes:FakePolicy"]
    with pytest.raises(UserError, match="was changed while it was evaluated"):
        runner.run(Job(str(folder), "another digest", Condition("none"), 1))


@pytest.mark.parametrize("setting", ["three", "three-rgbd"])
@pytest.mark.parametrize(
    ("occlusion", "drawn"),
    [
        (Occlusion("black"), 0),
        (Occlusion("mean"), 0),
        (Occlusion("noise"), 0),
        (Occlusion("freeze"), 1),
        (Occlusion("noise", 0.5), None),
        (Occlusion("delay", 0.3), None),
    ],
)
def test_pictures_that_do_not_matter_are_not_drawn_and_nothing_else_changes(
    monkeypatch, setting, occlusion, drawn
):
    def episode():
        counted, inputs, env = [], [], ToyReach()
        view = env.view
        monkeypatch.setattr(env, "view", lambda camera: counted.append(camera) or view(camera))
        policy = FakePolicy(setting=setting)
        ablation = Ablation({"third_a": CameraState(occlusion=occlusion)})
        mask = np.ones(len(policy.spec.streams), bool)

        def watch(_, stack, __, action):
            inputs.append((stack.views, action))

        result = run_episode(policy, env, mask, ablation, 60_000, watch=watch)
        return result, inputs, counted

    result, inputs, counted = episode()
    monkeypatch.setattr(Occlusion, "looks", lambda *_: True)
    before, inputs_before, counted_before = episode()
    assert result == before
    for (views, action), (views_before, action_before) in zip(inputs, inputs_before, strict=True):
        assert np.array_equal(views, views_before) and np.array_equal(action, action_before)
    assert counted_before.count("third_a") == len(inputs)
    assert counted.count("third_a") == (len(inputs) if drawn is None else drawn)
