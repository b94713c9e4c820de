"""A camera that sends its mean picture: the same one always, and nothing of the episode."""

from dataclasses import replace

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS, make_env
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure.episodes import run_episode
from madviz.measure.evaluate import evaluate
from madviz.measure.mean_picture import EPISODES, FIRST_SEED, PICTURES, _frames, mean_pictures
from madviz.observation.ablation import Ablation, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_occlusions
from madviz.observation.streams import StreamStack, stream_frame
from madviz.session.commands import SetCamera
from madviz.session.simulation import Simulation
from madviz.subsets import camera_of
from tests.fakes import FakePolicy

STREAMS, RGBD = SETTINGS["three"].streams, SETTINGS["three-rgbd"].streams
ALL = np.ones(3, bool)


@pytest.mark.parametrize("streams", [STREAMS, RGBD])
def test_it_is_the_mean_of_the_experts_pictures(streams):
    env = ToyReach()
    found = mean_pictures(env.spec, streams)
    for stream in streams:
        frames = []
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
            env.reset(seed)
            for step in range(env.spec.horizon):
                if step in [round(k * env.spec.horizon / PICTURES) for k in range(PICTURES)]:
                    view = env.view(camera_of(stream))
                    frames.append(stream_frame(view, stream, env.spec).astype(np.float64))
                env.step(env.expert())
        assert len(frames) == EPISODES * PICTURES
        assert np.abs(found[stream] - np.mean(frames, 0)).max() <= 0.5
        assert found[stream].dtype == np.uint8


class Early(ToyReach):
    """Ends after ten decisions, as some tasks do at their first success."""

    def step(self, action):
        return replace(super().step(action), last=self._step == 10)


def test_pictures_of_an_episode_that_ends_early_are_from_before_its_end():
    world = Early()
    drawn = []
    view = world.view
    world.view = lambda camera, size=None: drawn.append(world._step) or view(camera, size)
    frames = _frames(world, True, FIRST_SEED, world.spec.horizon, STREAMS, 84)
    assert len(frames) == PICTURES and drawn[-3 * PICTURES :: 3] == [0, 2, 4, 6, 8]


def means(*cameras):
    """The condition in which ``cameras`` send their mean pictures."""
    return Condition("all", tuple((camera, Occlusion("mean")) for camera in cameras))


def test_it_does_not_depend_on_the_episode():
    env = make_env("toy/reach")
    stacks = []
    for seed in (1, 2):
        env.reset(seed)
        stack = StreamStack(env.spec, STREAMS, means=lambda: mean_pictures(env.spec, STREAMS))
        ablation = means("third_a").ablation(STREAMS)
        stack.push({camera: env.view(camera) for camera in STREAMS}, ablation, seed, 0)
        stacks.append(stack.views)
    same = [np.array_equal(stacks[0][i], stacks[1][i]) for i in range(3)]
    assert same == [False, True, False]


def test_without_mean_pictures_it_says_so():
    env = make_env("toy/reach")
    env.reset(0)
    ablation = means("first").ablation(STREAMS)
    with pytest.raises(UserError, match="expected mean pictures"):
        StreamStack(env.spec, STREAMS).push({}, ablation, 0, 0)


def test_an_evaluation_and_the_page_send_the_same_one():
    policy, env = FakePolicy(), make_env("toy/reach")
    blind = means(*STREAMS).ablation(STREAMS)
    first = run_episode(policy, env, ALL, blind, 5)
    assert run_episode(policy, env, ALL, blind, 5) == first
    simulation = Simulation(make_env("toy/reach"), policy, Ablation())
    for name in STREAMS:
        simulation.ablation = simulation.ablation.replace(name, blind.camera(name))
    simulation.begin(5)
    while not simulation.ended:
        simulation.step(lambda: None)
    # All subsets are read in one product there: the last bits differ.
    assert simulation.record.total_reward == pytest.approx(first.total_reward, rel=1e-4)


def test_it_begins_in_mid_episode_at_once():
    simulation = Simulation(make_env("toy/reach"), FakePolicy(), Ablation())
    simulation.begin(5)
    simulation.step(lambda: None)
    wanted = mean_pictures(simulation.env.spec, STREAMS)["third_b"]
    assert not np.array_equal(simulation.arrived["third_b"], wanted)
    blind = means("third_b").ablation(STREAMS)
    simulation.set_camera(SetCamera("third_b", blind.camera("third_b")))
    assert np.array_equal(simulation.arrived["third_b"], wanted)


def test_it_is_another_input_than_black():
    rates = {
        what: evaluate(
            FakePolicy(), ("all",), episodes=2, occlusions=parse_occlusions([f"first={what}"])
        ).episodes
        for what in ("mean", "black")
    }
    assert rates["mean"] != rates["black"]
