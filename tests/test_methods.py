"""Every method, whole and tiny: trains by both recipes, loads, acts, and refuses what it must."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.merges.merge_table import MERGES
from madviz.agent.merges.mvd import contrastive_loss
from madviz.agent.merges.vib import kl_loss
from madviz.agent.methods import METHODS
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import OwnOptions
from madviz.analysis.probes import probe
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure.episodes import run_episode
from madviz.observation.ablation import Ablation
from madviz.policies import checkpoint
from madviz.policies.listing import ListConfig, run_list
from madviz.runs.demonstrations import Driver, record_episode
from madviz.runs.run_folder import RunFolder
from madviz.subsets import every_mask, mask_of
from madviz.training import light
from madviz.training.config import TrainConfig, resolve
from madviz.training.light import LightConfig, LightRun
from madviz.training.paper import PaperConfig
from madviz.training.train import train
from madviz.training.vectorised import VectorisedConfig
from madviz.types import Environment, PolicySpec
from tests.plans import OWN, record_inline, toy_plan

STREAMS = SETTINGS["three"].streams
HORIZON = 4
LIGHT = LightConfig(
    rounds=2, demonstrations=1, episodes_per_round=4, updates_per_round=2, batch_size=4,
    hidden_dim=8, critic_updates=2,
)  # fmt: skip
PAPER = PaperConfig(
    steps=8, exploration_steps=5, batch_size=3, hidden_dim=8, eval_every=1000, eval_episodes=1,
)  # fmt: skip


def short_toy() -> ToyReach:
    env = ToyReach()
    env.spec = replace(env.spec, horizon=HORIZON)
    return env


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(task: str, render_profile: str, cameras=()) -> Environment:
        return short_toy()

    monkeypatch.setattr("madviz.runs.drawn_task.make_env", make)
    record_inline(monkeypatch)


def config(method: str, recipe: str = "light", **changes: Any) -> TrainConfig:
    own = OWN.get(method, OwnOptions())
    whole = TrainConfig("toy/reach", method, recipe, own=own, light=LIGHT, paper=PAPER, threads=1)
    return replace(whole, **changes)


def trained(folder: Path, whole: TrainConfig) -> Path:
    return train(replace(whole, out=folder), lambda event: None)


def untrained(whole: TrainConfig) -> dict[str, torch.Tensor]:
    """The weights that a light run of ``whole`` begins with."""
    return resolve(whole).new_agent().acting_state()


def acts_where_it_says(folder: Path, words: str) -> None:
    """On every subset a policy acts, or refuses in one line that says what it needs."""
    policy = checkpoint.load_policy(folder)
    streams, env = policy.spec.streams, short_toy()
    views = np.random.default_rng(0).integers(0, 256, (len(streams), 9, 84, 84), np.uint8)
    encoded = policy.encode(views, np.zeros(6, np.float32))
    assert encoded.features.shape[0] == len(streams) and np.isfinite(encoded.features).all()
    found = probe(policy, encoded)
    for index, mask in enumerate(every_mask(len(streams))):
        supported = policy.supports(mask)
        assert supported == MERGES[policy.agent.merge_name].support.allows(mask)  # type: ignore[attr-defined]
        assert np.isfinite(found.readout.action[index]).all() == supported
        assert np.isfinite(found.readout.q[index]) == supported
        if not supported:
            with pytest.raises(UserError, match=words) as error:
                policy.read(encoded, mask)
            assert "\n" not in str(error.value)
            with pytest.raises(UserError, match="cannot act on"):
                run_episode(policy, env, mask, Ablation(), 5)
    for name in policy.spec.trained_subsets:
        mask = mask_of(name, streams)
        assert policy.supports(mask), name
    one, two = (run_episode(policy, env, mask, Ablation(), 7) for _ in range(2))
    assert one == two, "an episode is a function of its seed"


@pytest.mark.parametrize("method", [name for name in METHODS if "light" in METHODS[name].recipes])
def test_light(method: str, tmp_path: Path) -> None:
    whole = config(method)
    folder = trained(tmp_path / "run", whole)
    now, before = load_file(folder / "weights.safetensors"), untrained(whole)
    assert {t.dtype for t in now.values()} == {torch.float16}
    for part in ("encoder", "actor", "critic"):
        names = [name for name in now if name.startswith(part)]
        assert any(not torch.equal(now[n], before[n].half()) for n in names), part
    described = json.loads((folder / "config.json").read_text())
    assert described["method"] == method and described["merge"] == METHODS[method].merge
    assert described.get("camera") == ("first" if method == "single" else None)
    told = LIGHT.alpha if method in ("mad", "mv-mae") else None
    assert described["training"].get("alpha") == told, "no number that changes nothing"
    acts_where_it_says(folder, "bring the missing cameras back")


@pytest.mark.parametrize("method", [name for name in METHODS if "paper" in METHODS[name].recipes])
def test_paper(method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RunFolder, "finish", lambda self: None)  # The last state is looked at.
    folder = trained(tmp_path / "run", config(method, "paper"))
    state = torch.load(folder / "resume" / "state.pt", weights_only=True)
    assert state["updates"] == 1 and np.isfinite(list(state["losses"].values())).all()
    header = (folder / "curve.csv").read_text().splitlines()[0].split(",")
    measured = {name.removeprefix("success_") for name in header if name.startswith("success_")}
    alone = MERGES[METHODS[method].merge].support.allows(np.array([True, False, False]))
    streams = STREAMS if alone and method != "single" else ()
    assert measured == {"all", *streams}
    assert checkpoint.load_policy(folder).spec.method == method


@pytest.mark.parametrize("merge", ["attention", "vit", "q-mean"])
def test_mad_with_another_merge(merge: str, tmp_path: Path) -> None:
    whole = config("mad", merge=merge)
    assert resolve(whole).spec.name == f"toy-reach-mad-{merge}-light"
    folder = trained(tmp_path / "run", whole)
    policy = checkpoint.load_policy(folder)
    assert policy.spec.trained_subsets == ("all", *STREAMS)
    assert json.loads((folder / "config.json").read_text())["merge"] == merge
    acts_where_it_says(folder, "at least one stream")


def test_a_single_camera_is_part_of_the_name(tmp_path: Path) -> None:
    whole = config("single", camera="third_a", setting="three-rgbd")
    assert resolve(whole).spec.name == "toy-reach-single-third_a-three-rgbd-light"
    assert "--camera third_a" in resolve(whole).command
    folder = trained(tmp_path / "run", whole)
    spec = checkpoint.describe(folder).spec
    assert spec.streams == ("third_a.rgb", "third_a.depth") and spec.trained_subsets == ("all",)
    described = json.loads((folder / "config.json").read_text())
    assert described["camera"] == "third_a" and len(described["cameras"]) == 1


@pytest.mark.parametrize(
    ("method", "change", "message"),
    [
        ("mad", {"merge": "product"}, "unknown merge 'product'; known: attention"),
        ("mad", {"merge": "concat"}, "can form 'first', found 'concat', which needs all streams"),
        ("mad", {"merge": "vib"}, "found 'vib'; merges other than mvd, vib, mv-mae"),
        ("mv-mae", {"recipe": "paper"}, "'mv-mae' has the recipes light, not 'paper'"),
        ("mv-mwm", {"recipe": "light"}, "'mv-mwm' has the recipes mv-mwm, not 'light'"),
        ("mvd", {"merge": "attention"}, "the method's own merge 'mvd', found 'attention'"),
        ("single", {"camera": "thrid_a"}, "unknown camera 'thrid_a'; did you mean third_a"),
        ("mad", {"camera": "first"}, "--camera with the method single, found it with 'mad'"),
    ],
)
def test_what_does_not_go_together_costs_nothing(
    method: str, change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=message) as error:
        trained(tmp_path / "run", config(method, **change))
    assert "\n" not in str(error.value) and not (tmp_path / "run").exists()


@pytest.mark.parametrize("setting", [name for name in SETTINGS if SETTINGS[name].streams[1:]])
@pytest.mark.parametrize("method", ["mad", "singular-only", "naive-both", "mv-mae", "mv-mwm"])
def test_the_merge_is_one_row_in_every_setting(method: str, setting: str) -> None:
    masks = METHODS[method].masks(SETTINGS[setting].streams)
    assert masks.all(1).tolist() == [True, *[False] * (len(masks) - 1)]


@pytest.mark.parametrize(
    ("method", "streams", "message"),
    [
        ("mvd", ("first",), "2 or more streams, found 1"),
        ("vib", ("first.rgb", "first.depth"), "2 or more cameras, found first"),
        ("vib", ("third_a", "third_b"), "the camera 'first', found third_a, third_b"),
    ],
)
def test_a_setting_that_is_too_small(method: str, streams: tuple[str, ...], message: str) -> None:
    with pytest.raises(UserError, match=message):
        METHODS[method].rows(streams)


def test_the_list_shows_what_methods_need_and_support() -> None:
    methods = run_list(ListConfig())["methods"]
    assert set(methods) == set(METHODS)
    assert methods["vib"]["supports"] == "all streams together, or one alone"
    assert "the camera first" in methods["vib"]["needs"]
    assert all(row["recipes"] and row["summary"] for row in methods.values())


# --- What a light update minimises -----------------------------------------------------------


SEED = 1
"""Of a batch in which half of the decisions are an episode's last."""


def light_run(method: str, folder: Path) -> LightRun:
    plan = toy_plan(method, horizon=HORIZON, hidden_dim=8)
    run = LightRun(plan, replace(LIGHT, shift=0), folder)
    run.add([record_episode(short_toy(), STREAMS, Driver(), seed) for seed in range(2)], 0, [])
    return run


def stepped(run: LightRun, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """The losses of one update, none of which is followed."""
    losses: dict[str, float] = {}
    monkeypatch.setattr(run, "_step", lambda name, loss: losses.__setitem__(name, loss.item()))
    monkeypatch.setattr(light, "autocast", lambda: torch.autocast("cpu", enabled=False))
    run.update()
    return losses


@pytest.mark.parametrize("method", ["vib", "mvd"])
def test_a_light_update_is_imitation_and_the_methods_own_loss(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = light_run(method, tmp_path)
    run.rng = np.random.default_rng(SEED)
    index = np.random.default_rng(SEED).integers(0, 2 * HORIZON, LIGHT.batch_size)
    generator, agent = torch.Generator().manual_seed(0), run.agent
    noise = agent.encoder.noise(LIGHT.batch_size, generator)
    positive = int(torch.randint(3, (), generator=generator))
    losses = stepped(run, monkeypatch)

    views, encoder = run.data.views(index), agent.encoder
    row = agent.encoder.rows(agent.encoder.encode(views), torch.ones(1, 3), noise)[0]
    mean, _ = agent.actor(row, run.data.column("states", index))
    imitation = (torch.tanh(mean) - run.data.column("labels", index)).square().mean()
    if method == "vib":
        cost = kl_loss(*encoder.gaussian(agent.encoder.encode(views)))  # type: ignore[operator]
        assert losses == pytest.approx({"optimiser": (imitation + 0.01 * cost).item()}, rel=1e-5)
        return
    ends = index % HORIZON == HORIZON - 1
    assert ends.any() and not ends.all()
    following = run.data.views(np.where(ends, index, index + 1))
    keys = torch.stack([encoder.private(following[:, v]) for v in range(3)], 1)  # type: ignore[operator]
    contrast = contrastive_loss(agent.encoder.encode(views), keys, positive)
    expected = {"optimiser": imitation.item(), "contrast": contrast.item()}
    assert losses == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("method", ["mvd", "mv-mae"])
def test_a_resumed_light_run_repeats_its_draws(method: str, tmp_path: Path) -> None:
    (tmp_path / "again").mkdir()
    whole = light_run(method, tmp_path)
    again = LightRun(whole.plan, whole.config, tmp_path / "again")
    whole.update()
    state = copy.deepcopy(whole.state())
    whole.update()
    again.data = whole.data
    again.restore(state)
    again.update()
    for one, two in zip(whole.agent.parameters(), again.agent.parameters(), strict=True):
        assert torch.equal(one, two)


def test_drivers_are_the_trained_subsets(tmp_path: Path) -> None:
    masks = {}
    for method in ("singular-only", "vib", "mvd"):
        drivers = [driver for driver, _ in light_run(method, tmp_path).drivers(1)]
        masks[method] = {tuple(driver.mask) for driver in drivers if driver.mask is not None}
    singles = {tuple(row) for row in np.eye(3, dtype=bool)}
    assert masks["singular-only"] == singles
    assert masks["vib"] == {(True, True, True)}
    assert masks["mvd"] == {(True, True, True), *singles}


def test_at_alpha_one_a_policy_claims_all_cameras_alone_but_every_subset_drives(
    tmp_path: Path,
) -> None:
    merged_alone = replace(LIGHT, alpha=1.0)
    whole = TrainConfig("toy/reach", "mad", "light", out=tmp_path, threads=1, light=merged_alone)
    plan = resolve(whole)
    assert plan.spec.trained_subsets == ("all",)
    run = LightRun(plan, merged_alone, tmp_path)
    masks = {tuple(driver.mask) for driver, _ in run.drivers(1) if driver.mask is not None}
    assert masks == {(True, True, True), *(tuple(row) for row in np.eye(3, dtype=bool))}


def test_what_is_claimed_follows_the_alpha_of_every_recipe() -> None:
    def claimed(method: str, recipe: str, **options: Any) -> tuple[str, ...]:
        return resolve(TrainConfig("toy/reach", method, recipe, **options)).spec.trained_subsets

    assert claimed("mad", "paper") == ("all", *STREAMS)
    assert claimed("mad", "paper", paper=PaperConfig(alpha=1.0)) == ("all",)
    apart = VectorisedConfig(alpha=0.0)
    assert claimed("mad", "paper-vectorised", vectorised=apart) == STREAMS
    assert claimed("mad", "light", light=LightConfig(alpha=0.0)) == STREAMS
    assert len(claimed("mv-mwm", "mv-mwm")) == 7, "this recipe has no alpha"


def test_a_policy_says_what_it_cannot_do_without() -> None:
    spec = PolicySpec("p", "toy/reach", "concat", "three", "light", STREAMS, ("all",))
    policy = TorchPolicy(spec, Agent(NetworkConfig(6, 2, hidden_dim=8), 0.1, "concat", STREAMS))
    encoded = policy.encode(np.zeros((3, 9, 84, 84), np.uint8), np.zeros(6, np.float32))
    with pytest.raises(UserError, match="p expects all streams.*found 'first\\+third_b'"):
        policy.read(encoded, np.array([True, False, True]))
    with pytest.raises(UserError, match="found 2 marks"):
        policy.read(encoded, np.array([True, True]))
