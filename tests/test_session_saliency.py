"""Saliency in a session: on demand, twice a second, at once when paused, never at full speed."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from madviz.agent.agent import Agent, TorchPolicy
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState
from madviz.session.commands import (
    Pause,
    Play,
    Reset,
    Scrub,
    SetCamera,
    SetPolicy,
    SetSaliency,
    SetSpeed,
)
from madviz.session.frame import Frame, NoFrame
from madviz.session.session import Session
from tests.fakes import FakePolicy, policies


def torch_policy() -> TorchPolicy:
    env = make_env("toy/reach")
    sizes = NetworkConfig(env.spec.state_dim, env.spec.action_dim, hidden_dim=16)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        spec = replace(FakePolicy().spec, name="toy-torch")
        return TorchPolicy(spec, Agent(sizes))


class Clocked:
    """A session whose time is ours, asked to look at Q."""

    def __init__(self) -> None:
        self.now = 0.0
        self.session = Session(make_env, torch_policy(), policies)
        self.frames: list[Frame] = []
        self.session.subscribe(self.keep)

    def keep(self, frame: Frame | NoFrame) -> None:
        assert isinstance(frame, Frame)
        self.frames.append(frame)

    def tick(self, seconds: float, *commands) -> Frame:
        for command in commands:
            self.session.send(command)
        self.now += seconds
        self.session.tick(self.now)
        return self.frames[-1]

    def look(self) -> Frame:
        frame = self.tick(0.0, SetSaliency("q"))
        for _ in range(600):  # The first time, something large is imported in the background.
            if frame.saliency is not None:
                return frame
            time.sleep(0.1)
            frame = self.tick(0.0)
        raise AssertionError("no map ever came")


@pytest.fixture
def clocked() -> Clocked:
    made = Clocked()
    made.tick(0.0)
    return made


def test_maps_come_when_asked_for_and_go_when_not(clocked: Clocked) -> None:
    assert clocked.frames[-1].saliency is None
    saliency = clocked.look().saliency
    assert saliency is not None and list(saliency) == ["first", "third_a", "third_b"]
    assert clocked.tick(0.0, SetSaliency(None)).saliency is None


def test_what_was_switched_off_while_it_loaded_stays_off(clocked: Clocked) -> None:
    clocked.tick(0.0, SetSaliency("q"), SetSaliency(None))
    for thread in threading.enumerate():
        if thread.name == "madviz-captum":
            thread.join(60)
    assert [clocked.tick(1.0).saliency for _ in range(3)] == [None] * 3


def test_twice_a_second_while_it_runs(clocked: Clocked) -> None:
    first = clocked.look().saliency
    maps = [clocked.tick(0.1).saliency for _ in range(6)]
    assert maps[0] is first and maps[3] is first and maps[5] is not first


def test_at_once_while_it_stands_and_after_the_toggle_itself(clocked: Clocked) -> None:
    clocked.look()
    clocked.tick(0.0, Pause())
    clocked.tick(0.0, SetCamera("first", CameraState("off")))
    toggled, looked = [frame for frame in clocked.frames if frame.world.change is not None]
    assert not toggled.mask[0] and looked.saliency is not None
    assert np.ptp(looked.saliency["first"]) == 0 < np.ptp(looked.saliency["third_a"])


def test_never_at_full_speed(clocked: Clocked) -> None:
    clocked.look()
    clocked.tick(9.0, SetSpeed(None))
    assert clocked.tick(9.0).saliency is None
    assert clocked.tick(9.0, Pause()).saliency is not None


def test_another_episode_begins_with_a_map_of_its_own(clocked: Clocked) -> None:
    before = clocked.look().saliency
    clocked.tick(0.1, Reset(next_seed=True))
    started, looked = [frame for frame in clocked.frames if frame.world.episode == 2]
    assert started.saliency is None and looked.saliency is not before
    assert looked.saliency is not None


def test_a_policy_without_torch_has_none_and_nothing_breaks(clocked: Clocked) -> None:
    clocked.look()
    frame = clocked.tick(1.0, SetPolicy("toy-mad"))
    assert frame.saliency is None and not frame.pace.error
    assert clocked.tick(1.0).saliency is None


def test_an_earlier_step_that_is_shown_again_has_no_map(clocked: Clocked) -> None:
    clocked.look()
    clocked.tick(1.0)
    assert clocked.tick(1.0, Scrub(0)).saliency is None
    assert clocked.tick(1.0, Play()).saliency is not None
