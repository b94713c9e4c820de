"""Success against displacement: places, seeds, workers that put cameras back, the command."""

from __future__ import annotations

import numpy as np

from madviz.envs.toy import ToyReach
from madviz.measure.episodes import Job, Runner
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.types import Encoded, Readout
from tests.fakes import FakePolicy


class Seeker(FakePolicy):
    """Finds hand and target by their colours in the map of third_b: perfect in its place, and
    misled by as much as the camera is moved."""

    def encode(self, views, state):
        picture = views[2, -3:].astype(int)
        size = picture.shape[-1]
        axis = ((np.arange(size) + 0.5) / size * 2 - 1) * 1.15
        red = (picture[0] > 200) & (picture[2] < 80)
        where = np.argwhere(red).mean(0) if red.any() else np.full(2, size / 2)
        goal = np.array(
            [np.interp(where[1], range(size), axis), -np.interp(where[0], range(size), axis)]
        )
        return Encoded(np.tile(np.r_[goal, state[4:6]], (3, 1)).astype(np.float32), state)

    def read(self, encoded: Encoded, masks) -> Readout:
        goal, hand = encoded.features[0, :2], encoded.features[0, 2:]
        action = np.clip((goal - hand) / 0.12, -1, 1)
        count = len(np.atleast_2d(masks))
        return Readout(np.zeros((count, 4)), np.tile(action, (count, 1)), np.zeros(count))


def test_a_runner_puts_cameras_back_for_the_next_job():
    policy, runner = Seeker(), Runner()
    runner.adopt("", policy)
    there = Condition("all", (), (("third_b", Displacement(right=0.5)),))
    plain = Job("", policy.spec.digest, Condition("all"), 5000)
    moved = Job("", policy.spec.digest, there, 5000)
    first, away, again = (runner.run(job)[0] for job in (plain, moved, plain))
    assert first == again != away
    assert Condition("all").key() == ""
    assert there.key() == "third_b:moved,right=0.5"
    runner.close()


def test_the_toy_world_is_where_its_spec_says_afterwards():
    env = ToyReach()
    env.reset(0)
    before = env.view("third_a").rgb
    env.move_camera("third_a", Displacement(zoom=1.5).placed(env.spec.camera("third_a")))
    assert not np.array_equal(env.view("third_a").rgb, before)
    env.move_camera("third_a", None)
    assert np.array_equal(env.view("third_a").rgb, before)
