"""The paper recipe: its numbers, its schedule, and that stopping it changes nothing."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.update import Learner
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.policies.seeds import use_of
from madviz.runs import reward_run
from madviz.runs.recipe_options import SuiteNumbers
from madviz.runs.reward_run import RewardRun
from madviz.runs.run_folder import Event, RunFolder
from madviz.training import paper
from madviz.training.config import RECIPES, TrainConfig, resolve
from madviz.training.paper import PaperConfig, advance, evaluated, new_run, player, train_paper
from madviz.training.train import train
from madviz.training.vectorised import VectorisedConfig
from madviz.types import Array, Environment
from tests.plans import toy_plan
from tests.recipe_runs import assert_same_run, curve, stops_at

TINY = PaperConfig(
    steps=26, exploration_steps=10, batch_size=4, hidden_dim=8, eval_every=16, eval_episodes=1,
    save_every=7, precision="float32", buffer_on_host=True,
)  # fmt: skip
HORIZON = 6


@pytest.fixture(autouse=True)
def short_toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of six decisions, each of which claims to be two simulator steps."""

    def make(task: str, render_profile: str, cameras=()) -> Environment:
        env = ToyReach()
        env.spec = replace(env.spec, horizon=HORIZON, action_repeat=2)
        return env

    monkeypatch.setattr("madviz.runs.drawn_task.make_env", make)


class Killed(Exception):
    pass


def run(
    folder: Path, config: PaperConfig = TINY, resume: bool = False, listener: Any = None
) -> None:
    """As ``madviz train`` does it, but the last state stays, to be compared."""
    whole = TrainConfig("toy/reach", "mad", "paper", seed=3, paper=config)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "finish", lambda self: None)
        train_paper(resolve(whole), config, RunFolder(folder, whole, resume, listener))


def test_parts_of_the_buffer_that_no_state_needs_go_while_a_run_goes_on(tmp_path: Path) -> None:
    run(tmp_path, replace(TINY, buffer_capacity=8))
    parts = torch.load(tmp_path / "resume" / "state.pt", weights_only=True)["buffer"]["parts"]
    assert {file.name for file in (tmp_path / "resume" / "buffer").iterdir()} == set(parts)


def test_a_finished_run_gives_back_the_room_of_its_buffer(tmp_path: Path) -> None:
    whole = TrainConfig("toy/reach", "mad", "paper", seed=3, paper=TINY)
    train_paper(resolve(whole), TINY, RunFolder(tmp_path, whole, False, None))
    assert {file.name for file in (tmp_path / "resume").iterdir()} == {"run.json", "finished"}
    assert load_policy(tmp_path).spec.recipe == "paper"


def state_of(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "resume" / "state.pt", weights_only=True)


def assert_same(one: Path, other: Path) -> None:
    assert curve(one) == curve(other)
    assert_same_run(state_of(one), state_of(other))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper") / "undisturbed"


@pytest.fixture
def whole_run(undisturbed: Path) -> Path:
    if not undisturbed.exists():
        run(undisturbed)
    return undisturbed


def test_the_defaults_are_the_papers_table() -> None:
    config = PaperConfig()
    assert (config.steps, config.exploration_steps, config.update_every) == (500_000, 2_000, 2)
    assert (config.batch_size, config.buffer_capacity, config.hidden_dim) == (256, 500_000, 1024)
    assert (config.alpha, config.learning_rate, config.target_rate) == (0.8, 5e-4, 0.01)
    assert config.temperature == 0.1 and config.eval_episodes == 20
    assert config.same_shift_for_views and not config.shift_when_acting


def test_what_differs_between_suites_follows_from_the_task_unless_an_option_says_it() -> None:
    config = PaperConfig()
    assert config.numbers_of("metaworld/hammer") == SuiteNumbers(0.99, 25_000, bootstraps=True)
    assert config.numbers_of("maniskill/push-cube") == SuiteNumbers(0.8, 20_000, bootstraps=False)
    asked = PaperConfig(discount=0.5, eval_every=7, time_limit="goes-on")
    assert asked.numbers_of("maniskill/push-cube") == SuiteNumbers(0.5, 7, bootstraps=True)
    assert not PaperConfig(time_limit="ends").numbers_of("metaworld/hammer").bootstraps


def test_a_run_takes_its_tasks_numbers(tmp_path: Path) -> None:
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=HORIZON, hidden_dim=8)
    plan = replace(plan, spec=replace(plan.spec, task="maniskill/push-cube"))
    config = replace(TINY, eval_every=None, eval_episodes=0)
    env = ToyReach()
    env.spec = replace(env.spec, horizon=HORIZON)
    training = new_run(plan, config, RunFolder(tmp_path, config, False, None))
    training.evaluate(evaluated(training), player(env), lambda: False)
    assert training.evaluate_at == 20_000
    for _ in range(HORIZON + 1):
        advance(training, env)
    stored = training.buffer.batch(np.arange(HORIZON)).discount.tolist()
    assert stored == pytest.approx([0.8] * (HORIZON - 1) + [0])


def test_every_reset_draws_a_scene_that_serves_nothing_else(tmp_path: Path) -> None:
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=HORIZON, hidden_dim=8)
    training = new_run(plan, TINY, RunFolder(tmp_path, TINY, False, None))
    seeds = training.draw_seeds(5000)
    assert use_of(seeds) == "reinforcement learning" and len(set(seeds)) == 5000
    assert max(seeds) < 2**31


def test_both_recipes_learn_on_a_device_and_in_float32(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="expected a CUDA device for the option device = cuda"):
        PaperConfig(device="cuda").torch_device()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert PaperConfig().torch_device() == VectorisedConfig().torch_device() == "cuda"
    asked: list[Any] = []
    moved = Agent.to
    monkeypatch.setattr(Agent, "to", lambda agent, device: (asked.append(device), moved(agent))[1])
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=HORIZON, hidden_dim=8)
    training = new_run(plan, TINY, RunFolder(tmp_path, TINY, False, None))
    assert asked == ["cuda"] and not training.learner.low_precision


def test_the_schedule(whole_run: Path) -> None:
    state = state_of(whole_run)
    rows = curve(whole_run)
    assert state["step"] == 26 and state["episodes"] == 5
    assert state["updates"] == 8, "before the decisions 10, 12, ... 24"
    # 16 simulator steps are 8 decisions; the episodes end after 6, 12, 18, 24. Then the very end.
    assert [(row["step"], row["env_steps"]) for row in rows] == [
        ("0", "0"), ("12", "24"), ("18", "36"), ("24", "48"), ("26", "52"),
    ]  # fmt: skip
    subsets = {name.removeprefix("success_") for name in rows[0] if name.startswith("success_")}
    assert subsets == {"all", "first", "third_a", "third_b"}


def test_the_run_folder_is_a_policy(whole_run: Path) -> None:
    policy = load_policy(whole_run)
    assert policy.spec.recipe == "paper" and "third_a" in policy.spec.trained_subsets


@pytest.mark.parametrize("killed_at", [0, 12, 18, 24])
def test_a_killed_run_ends_the_same(whole_run: Path, tmp_path: Path, killed_at: int) -> None:
    def kill(event: Event) -> None:
        if event["kind"] == "curve" and event["step"] == killed_at:
            raise Killed

    with pytest.raises(Killed):
        run(tmp_path / "run", listener=kill)
    run(tmp_path / "run", resume=True)
    assert_same(tmp_path / "run", whole_run)


def test_ctrl_c_saves_in_mid_episode(whole_run: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reward_run, "PROGRESS_SECONDS", 0)
        run(tmp_path / "run", listener=stops_at(21))
    state = state_of(tmp_path / "run")
    assert state["step"] == 21 and not state["between_episodes"]
    run(tmp_path / "run", resume=True)
    assert_same(tmp_path / "run", whole_run)


def test_ctrl_c_abandons_an_evaluation(whole_run: Path, tmp_path: Path) -> None:
    asked: list[int] = []
    original = TorchPolicy.encode

    def encode(policy: TorchPolicy, *args: Any) -> Any:
        asked.append(1)
        if len(asked) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return original(policy, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TorchPolicy, "encode", encode)
        run(tmp_path / "run")
    assert len(asked) == 3 and not (tmp_path / "run" / "curve.csv").exists()
    run(tmp_path / "run", resume=True)
    assert_same(tmp_path / "run", whole_run)


def test_an_evaluation_that_is_repeated_is_in_the_curve_once(
    whole_run: Path, tmp_path: Path
) -> None:
    """Stopped in the first evaluation, then killed right after its row."""

    def killed(event: Any) -> None:
        if event["kind"] == "curve":
            raise Killed

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RewardRun, "evaluate", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        run(tmp_path / "run")
    with pytest.raises(Killed):
        run(tmp_path / "run", resume=True, listener=killed)
    run(tmp_path / "run", resume=True)
    assert curve(tmp_path / "run") == curve(whole_run)


def test_a_training_that_diverges_says_so(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="diverged: begin again with a smaller learning rate"):
        run(tmp_path, replace(TINY, steps=60, exploration_steps=8, learning_rate=1e30))


def test_another_configuration_is_not_resumed(whole_run: Path) -> None:
    with pytest.raises(UserError, match="another configuration"):
        run(whole_run, replace(TINY, alpha=0.5), resume=True)


def stored_discounts(tmp_path: Path, config: PaperConfig) -> list[float]:
    env = ToyReach()
    env.spec = replace(env.spec, horizon=3)
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=3, hidden_dim=8)
    training = new_run(plan, config, RunFolder(tmp_path, config, False, None))
    for _ in range(6):
        advance(training, env)
    return training.buffer.batch(np.array([0, 1, 2, 4, 5, 6])).discount.tolist()


def test_a_run_explores_uniformly_and_begins_with_the_temperature_asked_for(tmp_path: Path) -> None:
    config = replace(TINY, temperature=0.37, steps=601, exploration_steps=600, eval_every=10**6)
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=HORIZON, hidden_dim=8)
    env = ToyReach()
    env.spec = replace(env.spec, horizon=HORIZON)
    training = new_run(plan, config, RunFolder(tmp_path, config, False, None))
    assert training.learner.agent.log_temperature.exp().item() == pytest.approx(0.37)
    done: list[Array] = []
    step = env.step
    env.step = lambda action: (done.append(action), step(action))[1]  # type: ignore[method-assign]
    for _ in range(600):
        advance(training, env)
    actions = np.array(done)
    assert actions.shape == (600, 2) and (np.abs(actions) <= 1).all()
    np.testing.assert_allclose(np.quantile(actions, [0.1, 0.5, 0.9]), [-0.8, 0, 0.8], atol=0.1)


def test_a_run_that_would_learn_nothing_is_refused(tmp_path: Path) -> None:
    config = replace(TINY, steps=600, exploration_steps=600)
    plan = toy_plan(recipe="paper", streams=("first", "third_a"), horizon=HORIZON, hidden_dim=8)
    with pytest.raises(UserError, match="more steps than the 600 of exploration, found 600"):
        new_run(plan, config, RunFolder(tmp_path, config, False, None))


def test_bootstrapping_at_the_time_limit_is_a_switch(tmp_path: Path) -> None:
    assert stored_discounts(tmp_path / "yes", TINY) == pytest.approx([0.99] * 6)
    cut = replace(TINY, time_limit="ends")
    assert stored_discounts(tmp_path / "no", cut) == pytest.approx([0.99, 0.99, 0] * 2)


def test_shifting_when_acting_is_a_switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []

    def shift(views: torch.Tensor, rng: np.random.Generator, same_for_views: bool) -> torch.Tensor:
        seen.append(same_for_views)
        return views

    monkeypatch.setattr(paper, "random_shift", shift)
    monkeypatch.setattr(Learner, "update", lambda learner, batch: {})
    short = replace(TINY, steps=12, eval_every=1000)
    run(tmp_path / "off", short)
    assert not seen
    run(tmp_path / "on", replace(short, shift_when_acting=True))
    # 2 decisions of the policy, and 2 evaluations of 4 subsets and 6 decisions.
    assert seen == [True] * (2 + 2 * 4 * HORIZON)
    seen.clear()
    run(tmp_path / "apart", replace(short, shift_when_acting=True, same_shift_for_views=False))
    assert seen == [False] * (2 + 2 * 4 * HORIZON)


@pytest.mark.parametrize("recipe", ["paper", "paper-vectorised", "mv-mwm"])
def test_a_run_without_exploring_is_refused(recipe: str, tmp_path: Path) -> None:
    method = "mv-mwm" if recipe == "mv-mwm" else "mad"
    whole = TrainConfig("toy/reach", method, recipe, out=tmp_path / "run")
    section = RECIPES[recipe].options
    options = replace(getattr(whole, section), exploration_steps=0, steps=1, eval_episodes=0)
    with pytest.raises(UserError, match="exploration-steps: expected a whole number from 1 to"):
        train(replace(whole, **{section: options}), lambda event: None)
    assert not list(tmp_path.iterdir())


def test_a_refused_run_leaves_no_frames_on_the_disk(tmp_path: Path) -> None:
    """They would stand in the way of the command without the mistake."""
    short = replace(TINY, steps=8, exploration_steps=8, buffer_on_disk=True)
    whole = TrainConfig("toy/reach", "mad", "paper", out=tmp_path / "run", paper=short)
    with pytest.raises(UserError, match="nothing would be learned"):
        train(whole, lambda event: None)
    left = {file.name for file in tmp_path.rglob("*") if file.is_file()}
    assert not left & {"run.json", "first.frames", "first.rgb.frames"}


def test_one_decision_of_exploring_is_enough(tmp_path: Path) -> None:
    run(tmp_path, replace(TINY, steps=8, exploration_steps=1))
    assert state_of(tmp_path)["updates"] == 3  # Before decisions 2, 4 and 6.


def test_a_buffer_that_will_not_fit_is_refused_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="needs .* GB, found .* GB free"):
        run(tmp_path, replace(TINY, steps=10**9, buffer_capacity=10**9))
