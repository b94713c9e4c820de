"""Where things are, read from features: the linear map, what lies in a picture, and the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import places
from benchmarks.places import PlacesConfig, bench_places, in_picture, places_words, ridge
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.types import Array, CameraPose, Encoded, KnowsPlaces, Readout
from tests.fakes import FakePolicy

SHORT = PlacesConfig(policy="fake", episodes=30, judged=4, every=5)


def test_ridge_is_its_closed_form() -> None:
    rng = np.random.default_rng(0)
    inputs, targets = rng.normal(size=(60, 8)), rng.normal(size=(60, 3))
    new, penalty = rng.normal(size=(5, 8)), 0.3
    values = np.linalg.eigvalsh(inputs @ inputs.T).clip(0)
    weights = np.linalg.solve(
        inputs.T @ inputs + penalty * values.mean() * np.eye(8),
        inputs.T @ (targets - targets.mean(0)),
    )
    found = places._solve(inputs, targets, new, np.array([penalty]))[0]
    assert found == pytest.approx(targets.mean(0) + new @ weights, abs=1e-10)


def test_ridge_finds_a_linear_map_and_makes_no_more_than_the_mean_of_noise() -> None:
    rng = np.random.default_rng(1)
    inputs, new = rng.normal(size=(300, 40)), rng.normal(size=(100, 40))
    inputs[:, 7] = new[:, 7] = 3.0  # A number that never changes must not divide by 0.
    true, episodes = rng.normal(size=(40, 3)), np.repeat(np.arange(30), 10)
    targets = inputs @ true
    assert ridge(inputs, targets, episodes, new) == pytest.approx(new @ true, abs=0.05)
    noise = ridge(rng.normal(size=(300, 40)), targets, episodes, new) - targets.mean(0)
    assert np.abs(noise).mean() < 0.15 * np.abs(targets).mean()


def test_a_number_that_is_rarely_there_does_not_decide_all() -> None:
    rng = np.random.default_rng(2)
    inputs, new = rng.normal(size=(300, 5)), rng.normal(size=(100, 5))
    true, episodes = rng.normal(size=(5, 3)), np.repeat(np.arange(30), 10)
    rare, there = np.zeros((300, 1)), np.zeros((100, 1))
    rare[7], there[::4] = 1e-3, 1.0
    targets = inputs @ true
    targets[7] += 1.0
    found = ridge(np.hstack([inputs, rare]), targets, episodes, np.hstack([new, there]))
    assert np.abs(found - new @ true).max() < 1.5


def test_what_lies_in_a_picture_follows_from_the_cameras_pose() -> None:
    # One metre above the table, looking straight down (OpenCV axes: z ahead), 90 degrees.
    down = Rotation.from_euler("x", 180, degrees=True).as_quat(scalar_first=True)
    pose = CameraPose(np.array([0.0, 0.0, 1.0]), down, 90.0)
    points = np.array([[0, 0, 0], [0.9, -0.9, 0], [1.1, 0, 0], [0, 1.1, 0], [0, 0, 2.0]])
    assert in_picture(pose, points).tolist() == [True, True, False, False, False]


class Knowing(FakePolicy):
    """Its first stream's feature has the target in it, the others are the same in every frame."""

    def __init__(self) -> None:
        super().__init__("fake")
        self.env = make_env("toy/reach")

    def encode(self, views: Array, state: Array) -> Encoded:
        features = np.ones((len(views), 64), np.float32)
        features[0, :12] = views[0, -3:, ::28, ::28].reshape(-1)[:12]
        features[0, :2] = self.target
        return Encoded(features, state)

    target: tuple[float, float]


def test_a_stream_that_shows_the_target_is_told_from_those_that_do_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = Knowing()
    build = places.make_env

    def watched(*words: object):
        env = build(*words)  # type: ignore[arg-type]
        assert isinstance(env, KnowsPlaces)
        reset = env.reset

        def seen(seed: int):
            now = reset(seed)
            policy.target = tuple(env.places()[:2])
            return now

        monkeypatch.setattr(env, "reset", seen)
        return env

    monkeypatch.setattr(places, "make_env", watched)
    monkeypatch.setattr(places, "load_policy", lambda name: policy)
    found = bench_places(SHORT)
    rows = {row["stream"]: row for row in found["rows"]}
    assert {row["place"] for row in found["rows"]} == {"target"}
    assert rows["first"]["explained"] > 0.95 > 0.2 > rows["third_a"]["explained"]
    assert rows["third_a"]["feature_cm"] == pytest.approx(rows["third_a"]["mean_cm"], abs=0.01)
    assert rows["third_a"]["in_picture"] == 1.0
    assert found["frames"] == 4 * -(-policy.env.spec.horizon // 5)
    assert "target" in places_words(found).splitlines()[2]


def test_a_camera_alone_is_what_the_heads_read_of_it() -> None:
    class Tokens(FakePolicy):
        """Has no feature of a stream that is as its heads read it."""

        def encode(self, views: Array, state: Array) -> Encoded:
            return Encoded(np.arange(6, dtype=np.float32).reshape(3, 2), state)

        def read(self, encoded: Encoded, masks: Array) -> Readout:
            merged = 10 + masks @ encoded.features[:, :1]
            return Readout(merged, np.zeros((len(masks), 2)), np.zeros(len(masks)))

    policy = Tokens("fake")
    encoded = policy.encode(np.zeros((3, 9, 84, 84), np.uint8), np.zeros(6, np.float32))
    assert places.alone(policy, encoded).tolist() == [[10], [12], [14]]
    policy.supports = lambda mask: bool(np.all(mask))
    assert places.alone(policy, encoded).tolist() == encoded.features.tolist()


def test_a_policy_without_features_and_a_task_without_places_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Blind(FakePolicy):
        def encode(self, views: Array, state: Array) -> Encoded:
            return Encoded(np.zeros((len(views), 64), np.float32), state)

    monkeypatch.setattr(places, "load_policy", lambda name: Blind("fake"))
    with pytest.raises(UserError, match="fake, which has none"):
        bench_places(SHORT)
    policy = FakePolicy("fake", task="madviz.examples.own_task:make", actions=3)
    policy.spec = replace(policy.spec, render_profile="fast")
    monkeypatch.setattr(places, "load_policy", lambda name: policy)
    monkeypatch.setenv("MADVIZ_TASKS", "madviz.examples.own_task:make")
    with pytest.raises(UserError, match="says where its objects are"):
        bench_places(SHORT)
