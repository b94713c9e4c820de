"""The light recipe: its loss, its critic's targets, its data, and exact resumption."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.policies.checkpoint import load_policy
from madviz.runs.demonstrations import Dataset, Driver, Episode, record_episode
from madviz.runs.run_folder import RunFolder
from madviz.training.kept_episodes import episode_files
from madviz.training.light import LightConfig, LightRun, imitation_loss, run_rounds, train_light
from madviz.training.light_critic import GAMMA, STEPS, fit_critic, n_step_returns
from madviz.types import Array
from tests.fakes import random_policy
from tests.plans import THREE, InlineRecorder, record_inline, toy_plan

RGBD = SETTINGS["three-rgbd"].streams
TOY = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=16)
TINY = LightConfig(
    rounds=4, demonstrations=2, episodes_per_round=4, updates_per_round=3, batch_size=4,
    critic_updates=0,
)  # fmt: skip
DIALS = replace(
    TINY, final_rounds=2, recency=1.0, learning_rate_floor=0.1, standard_state=True,
    position_weight=0.1, gripper_loss="cross-entropy", noise_share=0.0, noise_spread=0.2,
    focus=0.5,
)  # fmt: skip
"""Everything that is off by default."""


def run_in(folder: RunFolder, config: LightConfig = TINY) -> LightRun:
    run = LightRun(toy_plan(), config, folder.resume)
    state = folder.load_state()
    if state:
        run.restore(state)
    return run


def finish(run: LightRun, folder: RunFolder, recorder: InlineRecorder) -> None:
    run_rounds(run, folder, recorder)  # type: ignore[arg-type]


def weights(run: LightRun) -> torch.Tensor:
    return torch.cat([p.flatten() for p in (*run.agent.parameters(), *run.average.parameters())])


@pytest.mark.parametrize("streams", [THREE, RGBD])
def test_imitation_loss_is_the_formula(streams: tuple[str, ...]) -> None:
    rng, agent = np.random.default_rng(0), Agent(TOY)
    views = torch.from_numpy(rng.integers(0, 256, (2, len(streams), 9, 84, 84), np.uint8))
    state, label = torch.randn(2, 6), torch.rand(2, 2)
    method, alpha = METHODS["mad"], 0.3
    masks = torch.from_numpy(method.masks(streams))
    share = torch.from_numpy(method.row_weights(streams, alpha))
    rows = agent.encoder.encode_and_merge(views, masks)[1]
    found = imitation_loss(agent, rows, state, label, share).item()

    exact = agent.double()
    subsets = ["all", *method.subsets(streams)]
    errors = []
    for name in subsets:
        present = [s for s in streams if _is_in(s, name)]
        merged = torch.zeros(2, 3136, dtype=torch.float64)
        for stream in present:
            merged += exact.encoder(views[:, streams.index(stream)])
        mean, _ = exact.actor(merged, state.double())
        errors.append((torch.tanh(mean) - label.double()).square().mean().item())
    expected = alpha * errors[0] + (1 - alpha) * np.mean(errors[1:])
    assert found == pytest.approx(expected, rel=1e-4)


def _is_in(stream: str, subset: str) -> bool:
    camera, _, modality = stream.partition(".")
    return subset in ("all", stream, camera, modality)


def test_imitation_reaches_encoder_and_actor_alone() -> None:
    agent = Agent(TOY)
    views = torch.randint(0, 256, (2, 3, 9, 84, 84), dtype=torch.uint8)
    masks = torch.from_numpy(METHODS["mad"].masks(THREE))
    share = torch.from_numpy(METHODS["mad"].row_weights(THREE, 0.5))
    rows = agent.encoder.encode_and_merge(views, masks)[1]
    imitation_loss(agent, rows, torch.randn(2, 6), torch.rand(2, 2), share).backward()
    touched = {name.split(".")[0] for name, p in agent.named_parameters() if p.grad is not None}
    assert touched == {"encoder", "actor"}


def test_n_step_returns_stop_at_the_end_of_an_episode() -> None:
    horizon = 30
    rewards = np.random.default_rng(0).random(2 * horizon).astype(np.float32)
    sums, ahead, discount = n_step_returns(rewards, horizon)
    for t in (0, 12, 25, 28, 31, 58):
        last = t // horizon * horizon + horizon - 1
        terms = min(STEPS, last - t)
        expected = sum(GAMMA**k * rewards[t + k] for k in range(terms))
        assert sums[t] == pytest.approx(expected, rel=1e-5)
        assert ahead[t] == t + terms and discount[t] == pytest.approx(GAMMA**terms)
    assert sums[29] == rewards[29] and ahead[29] == 29 and discount[29] == pytest.approx(GAMMA)


def test_fitting_the_critic_changes_nothing_else() -> None:
    data = Dataset(THREE, 2, 25)
    for seed in range(2):
        data.add(record_episode(ToyReach(), THREE, Driver(), seed))
    agent = Agent(TOY)
    before = {k: v.clone() for k, v in agent.state_dict().items()}
    first = fit_critic(agent, data, METHODS["mad"], 0.5, updates=3, seed=0)
    later = fit_critic(agent, data, METHODS["mad"], 0.5, updates=60, seed=0)
    changed = {
        k.split(".")[0] for k, v in agent.state_dict().items() if not torch.equal(v, before[k])
    }
    assert changed == {"critic", "target"}
    assert later < first


def test_a_recorded_episode_repeats_to_the_bit() -> None:
    student = random_policy(toy_plan().spec, TOY)
    driver = Driver(0.5, 0.2, student, np.array([True, False, False]))
    one, two = (record_episode(ToyReach(), THREE, driver, 3) for _ in range(2))
    assert np.array_equal(one.actions, two.actions)
    assert all(np.array_equal(one.frames[s], two.frames[s]) for s in THREE)
    assert not np.array_equal(one.actions, one.labels)


def test_a_task_whose_episodes_end_early_is_refused() -> None:
    env = ToyReach()
    step = env.step
    env.step = lambda action: replace(step(action), last=True)  # type: ignore[method-assign]
    with pytest.raises(UserError, match=r"all 25 decisions, found one that ended after 1; only"):
        record_episode(env, THREE, Driver(), 3)


def test_an_episode_comes_back_from_its_file(tmp_path: Path) -> None:
    episode = record_episode(ToyReach(), RGBD, Driver(), 1)
    episode.save(tmp_path / "e.npz")
    back = Episode.load(tmp_path / "e.npz")
    assert np.array_equal(back.frames["first.depth"], episode.frames["first.depth"])
    assert back.frames["first.depth"].shape == (25, 1, 84, 84)
    assert np.array_equal(back.labels, episode.labels) and back.success == episode.success


def test_stacks_of_a_dataset_do_not_reach_over_a_start() -> None:
    data = Dataset(THREE, 2, 25)
    for seed in range(2):
        data.add(record_episode(ToyReach(), THREE, Driver(), seed))
    start, later = data.views(np.array([25, 28]))
    frame = start[:, :3]
    assert torch.equal(start, torch.cat([frame] * 3, 1))
    assert not torch.equal(later[0, :3], later[0, 6:])


@pytest.mark.parametrize("config", [TINY, DIALS], ids=["default", "dials"])
def test_a_killed_run_goes_on_as_if_nothing_had_happened(
    tmp_path: Path, config: LightConfig
) -> None:
    whole = RunFolder(tmp_path / "whole", config, resume=False, listener=None)
    uninterrupted = run_in(whole, config)
    finish(uninterrupted, whole, InlineRecorder())

    broken = RunFolder(tmp_path / "broken", config, resume=False, listener=None)
    with pytest.raises(KeyboardInterrupt):
        finish(run_in(broken, config), broken, InlineRecorder(breaks_after=3))
    again = RunFolder(tmp_path / "broken", config, resume=True, listener=None)
    resumed = run_in(again, config)
    assert 0 < resumed.round < config.rounds
    finish(resumed, again, InlineRecorder())
    assert resumed.updates == uninterrupted.updates == config.all_rounds * 3
    assert torch.equal(weights(resumed), weights(uninterrupted))
    assert resumed.data.episodes == 2 + 3 * 4, "the last rounds record nothing"
    assert (whole.path / "curve.csv").read_text().count("\n") == config.all_rounds + 1
    found = load_policy(whole.path)
    assert isinstance(found, TorchPolicy)
    assert found.agent.config == uninterrupted.average.config
    assert bool(found.agent.config.state_mean) == config.standard_state


@pytest.mark.parametrize(("after", "call"), [("report", 1), ("report", 2), ("save_state", 2)])
def test_a_kill_leaves_every_row_of_the_curve_once(
    after: str, call: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = replace(TINY, rounds=3, demonstrations=1, episodes_per_round=1, updates_per_round=1)
    record_inline(monkeypatch)
    folder = RunFolder(tmp_path, short, resume=False, listener=None)
    plain, calls = getattr(folder, after), iter(range(1, 10))

    def killed(*args: Any, **values: Any) -> None:
        plain(*args, **values)
        if next(calls) == call:
            raise KeyboardInterrupt

    monkeypatch.setattr(folder, after, killed)
    with pytest.raises(KeyboardInterrupt):
        train_light(toy_plan(), short, folder)
    train_light(toy_plan(), short, RunFolder(tmp_path, short, resume=True, listener=None))
    rows = (tmp_path / "curve.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["round", "1", "2", "3"]


class NumpySuccess(ToyReach):
    """As a task of one's own may say it; a saved state takes no NumPy objects."""

    def step(self, action: Array) -> Any:
        return SimpleNamespace(**vars(super().step(action)) | {"success": np.True_})


def test_the_success_of_an_episode_can_be_saved_with_a_state() -> None:
    assert record_episode(NumpySuccess(), THREE, Driver(), 1).success is True


def test_more_than_a_hundred_episodes_come_back_in_order(tmp_path: Path) -> None:
    env, many = ToyReach(), replace(TINY, demonstrations=101)
    env.spec = replace(env.spec, horizon=1)
    episode = record_episode(env, THREE, Driver(), 1)
    run, again = (LightRun(toy_plan(horizon=1), many, tmp_path) for _ in range(2))
    numbers = np.arange(101, dtype=np.float32)
    run.add([replace(episode, rewards=numbers[n : n + 1]) for n in range(101)], 0, [])
    again.restore(run.state())
    assert np.array_equal(again.data.column("rewards", np.arange(101)), numbers)


def test_episodes_of_a_run_that_never_began_are_none_of_the_next(tmp_path: Path) -> None:
    few = replace(TINY, demonstrations=1)
    for config in (replace(TINY, demonstrations=3), few):
        run = LightRun(toy_plan(), config, tmp_path)
        run.add([record_episode(ToyReach(), THREE, Driver(), 1)] * config.demonstrations, 0, [])
    assert [len(files) for files in episode_files(tmp_path / "episodes").values()] == [1]


def test_a_state_of_an_older_version_is_refused_in_words(tmp_path: Path) -> None:
    run = run_in(RunFolder(tmp_path, TINY, resume=False, listener=None))
    numbers = {"bit_generator": "PCG64", "has_uint32": "int:0"}
    with pytest.raises(UserError, match="an older version saved.*another --out"):
        run.restore({**run.state(), "rng": numbers})


def test_students_see_their_methods_subsets_and_demonstrations_are_shared(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "a", TINY, resume=False, listener=None)
    mad = run_in(folder)
    merged = LightRun(toy_plan("merged-only"), TINY, folder.resume)
    assert mad.drivers(0) == merged.drivers(0)
    assert [seed for _, seed in mad.drivers(2)] == [seed for _, seed in merged.drivers(2)]
    seen = {tuple(driver.mask) for driver, _ in mad.drivers(1) if driver.mask is not None}
    assert len(seen) == 4
    assert all(driver.mask is not None and driver.mask.all() for driver, _ in merged.drivers(1))
    assert all(seed < 1000 for _, seed in mad.drivers(3))


def test_noise_fades_from_round_to_round_where_it_is_told_to(tmp_path: Path) -> None:
    run = run_in(RunFolder(tmp_path / "a", TINY, resume=False, listener=None))
    run.config = replace(TINY, noise_share=0.4, noise_decay=0.5)
    noise = [{driver.noise_share for driver, _ in run.drivers(round_)} for round_ in range(4)]
    assert noise == [{0.4}, {0.4}, {0.2}, {0.1}]


def test_a_folder_holds_one_run(tmp_path: Path) -> None:
    RunFolder(tmp_path, TINY, resume=False, listener=None)
    with pytest.raises(UserError, match="--resume"):
        RunFolder(tmp_path, TINY, resume=False, listener=None)
    with pytest.raises(UserError, match="rounds 4 -> 5"):
        RunFolder(tmp_path, replace(TINY, rounds=5), resume=True, listener=None)
    with pytest.raises(UserError, match="nothing to resume"):
        RunFolder(tmp_path / "other", TINY, resume=True, listener=None)


def test_a_policy_that_came_from_elsewhere_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="holds a policy that was not trained here; choose another"):
        RunFolder(tmp_path, TINY, resume=False, listener=None)
    assert [file.name for file in tmp_path.iterdir()] == ["config.json"]


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="expected a folder"):
        RunFolder(tmp_path / "file", TINY, resume=False, listener=None)


def test_a_card_says_who_drove_the_episodes() -> None:
    assert "the student's own states" in LightConfig().how
    assert LightConfig().driven_by_expert(98) == 10
    expert = LightConfig(drivers="expert")
    assert "drove all episodes" in expert.how and expert.driven_by_expert(98) == 98
    kept = LightConfig(episodes="runs/other")
    assert "another run's episodes" in kept.how and kept.driven_by_expert(98) == 10
