"""Tasks of one's own whose facts and conduct do not fit each other: one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from madviz.envs.registry import env_spec, make_env
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.examples.own_task import TouchBall
from madviz.measure.episodes import run_episode
from madviz.measure.mean_picture import mean_pictures
from madviz.observation.ablation import Ablation
from madviz.observation.streams import stream_frame
from madviz.recording.lerobot import expert_decisions
from madviz.runs.demonstrations import Driver, record_episode
from madviz.state_numbers import StateNumbers
from madviz.types import Array, TimeStep, View
from tests.fakes import FakePolicy

ALL = np.ones(3, bool)
STREAMS = ("first", "third_a", "third_b")


PLAYS: tuple[Callable[[Any], object], ...] = (
    lambda env: run_episode(FakePolicy(), env, ALL, Ablation(), 0),
    lambda env: record_episode(env, STREAMS, Driver(), 0),
    lambda env: list(expert_decisions(env, STREAMS, 0, 0)),
)


def toy(**facts: Any) -> ToyReach:
    made = ToyReach()
    made.spec = replace(made.spec, **facts)
    return made


def states(**numbers: Any) -> ToyReach:
    return toy(state_numbers=StateNumbers(**numbers))


def named(*names: str) -> ToyReach:
    cameras = ToyReach().spec.cameras
    return toy(cameras=tuple(replace(c, name=n) for c, n in zip(cameras, names, strict=True)))


class Endless(ToyReach):
    def step(self, action: np.ndarray) -> TimeStep:
        return replace(super().step(action), last=False)


class NoExpert(ToyReach):
    def expert(self) -> np.ndarray:
        raise NotImplementedError("no expert")


def sized(size: int) -> ToyReach:
    env = ToyReach()
    cameras = tuple(replace(camera, size=size) for camera in env.spec.cameras)
    env.spec = replace(env.spec, cameras=cameras)
    return env


class Fixed(ToyReach):
    def __setattr__(self, name: str, value: Any) -> None:
        if name == "spec" and hasattr(self, "spec"):
            raise AttributeError("property 'spec' has no setter")
        super().__setattr__(name, value)


def failing() -> ToyReach:
    return ToyReach("reach", "fast", 3)  # type: ignore[arg-type]


MAKERS: dict[str, tuple[Callable[[], ToyReach], str]] = {
    "word": (lambda: named("all", "left", "right"), "none of them all, .*found 'all'"),
    "dot": (lambda: named("images.top", "left", "right"), "found 'images.top'; rename"),
    "twice": (lambda: named("left", "left", "right"), "each once, .*found 'left'"),
    "large": (lambda: sized(640), "cameras of 16 to 512 pixels a side, found first of 640"),
    "small": (lambda: sized(8), "found first of 8"),
    "start": (lambda: states(start=(77,)), "state_numbers from 0 to 5, found 77"),
    "angles": (lambda: states(angles=(6,)), "state_numbers from 0 to 5, found 6"),
    "before": (lambda: states(changes=((0, -1),)), "state_numbers from 0 to 5, found -1"),
    "fixed": (Fixed, "expected an attribute spec that can be set"),
    "failing": (failing, r"called without arguments, found TypeError.*\(.*\.py, line \d+\)"),
}


def own(monkeypatch: pytest.MonkeyPatch, maker: Callable[[], ToyReach]) -> str:
    monkeypatch.setattr("tests.test_own_tasks.make", maker, raising=False)
    task = "tests.test_own_tasks:make"
    monkeypatch.setenv("MADVIZ_TASKS", task)
    monkeypatch.setattr("madviz.envs.custom._SPECS", {})
    return task


@pytest.mark.parametrize(("maker", "said"), MAKERS.values(), ids=MAKERS)
def test_facts_that_fit_nothing_are_refused(
    maker: Callable[[], ToyReach], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match=said):
        make_env(own(monkeypatch, maker))


def test_an_episode_that_never_ends_is_refused_at_its_horizon() -> None:
    with pytest.raises(UserError, match="last=True after its 25 decisions"):
        run_episode(FakePolicy(), Endless(), ALL, Ablation(), 0)


def test_a_state_of_another_size_is_refused_at_the_first_step() -> None:
    for play in PLAYS:
        with pytest.raises(UserError, match=r"give 7 state numbers, .*found the shape \(6,\)"):
            play(toy(state_dim=7))


def test_a_picture_that_is_no_square_is_refused() -> None:
    wide = View(np.zeros((84, 168, 3), np.uint8), np.ones((84, 168), np.float32))
    for stream in ("first", "first.depth"):
        with pytest.raises(UserError, match="square picture of first, found 84 x 168"):
            stream_frame(wide, stream, ToyReach().spec)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda rgb: rgb.astype(np.float32) / 255, "uint8, found .84, 84, 3. float32; convert it"),
        (
            lambda rgb: np.concatenate([rgb, rgb[..., :1]], -1),
            "found .84, 84, 4. uint8; give three channels",
        ),
        (lambda rgb: None, "expected a View of first, found None"),
    ],
)
def test_pictures_of_another_kind_are_refused(made: Callable[[Array], Any], said: str) -> None:
    class Odd(ToyReach):
        def view(self, camera: str, size: int | None = None) -> Any:
            view = super().view(camera, size)
            rgb = made(view.rgb)
            object.__setattr__(view, "rgb", rgb)  # As nothing checks it outside of tests.
            return None if rgb is None else view

    for play in PLAYS:
        with pytest.raises(UserError, match=said):
            play(Odd())


def test_a_state_that_is_no_number_is_refused_at_its_step() -> None:
    class Odd(ToyReach):
        def step(self, action: Array) -> TimeStep:
            now = super().step(action)
            return replace(now, state=now.state * np.float32("nan"))

    for play in PLAYS:
        with pytest.raises(UserError, match="toy/reach to give finite state numbers, found .nan"):
            play(Odd())


def test_an_expert_with_too_many_numbers_is_refused() -> None:
    class Wide(ToyReach):
        def expert(self) -> Array:
            return np.zeros(5)

    with pytest.raises(UserError, match="expected 2 finite numbers of the expert"):
        record_episode(Wide(), STREAMS, Driver(), 0)


def test_without_an_expert_there_are_mean_pictures_and_no_imitation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(UserError, match="expected an expert of toy/reach.*--recipe paper"):
        record_episode(NoExpert(), STREAMS, Driver(), 0)
    means = mean_pictures(env_spec(own(monkeypatch, NoExpert)), STREAMS)
    assert {frame.shape for frame in means.values()} == {(84, 84, 3)}


def test_a_body_looks_as_it_does_in_this_episode() -> None:
    class Painted(TouchBall):
        def reset(self, seed: int) -> TimeStep:
            self._model.geom_rgba[:, :3] = np.random.default_rng(seed).random(3)
            return super().reset(seed)

    env = Painted()
    env.reset(1)
    first = env.bodies()
    assert env.bodies() is first
    env.reset(1)
    assert env.bodies() is first
    env.reset(2)
    assert env.bodies() is not first
    env.close()


def test_a_picture_of_lerobots_push_depends_on_its_seed_alone() -> None:
    seen = []
    for before in (False, True):
        env = make_env("lerobot/push")
        if before:
            env.reset(3)
            for _ in range(100):
                env.step(env.expert())
        env.reset(7)
        seen.append((env.view("third_a", 84).rgb, env.body_poses()))
        env.close()
    for fresh, later in zip(*seen, strict=True):
        np.testing.assert_array_equal(fresh, later)


@pytest.mark.parametrize(
    "facts",
    [
        {"streams": ("first.rgb", "first.dept")},
        {"streams": ("first", "first")},
        {"streams": ("first.",)},
        {"streams": ()},
        {"frame_stack": 0},
        {"image_size": 0},
    ],
)
def test_streams_of_a_policy_that_are_none_are_refused(facts: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="^toy-mad: expected"):
        replace(FakePolicy().spec, **facts)
