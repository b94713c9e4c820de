"""Lesson 8's part on imagination, with the policy that ships for it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

import madviz
from madviz import teaching
from madviz.agent.sizes import NetworkConfig
from madviz.analysis.imagination import moving_psnr
from madviz.errors import UserError
from madviz.teaching.imagining import foreseen_sheet, imagined_at, imagined_psnr, imagined_sheet
from madviz.teaching.show import LABEL
from madviz.types import Array, Imagines
from tests.fakes import random_policy
from tests.plans import toy_plan


@pytest.fixture(scope="module")
def episode() -> list[teaching.Moment]:
    """Eight time steps with all cameras."""
    policy = madviz.load_policy("toy-reach-mv-mwm-mv-mwm")
    return list(islice(teaching.moments(policy, seed=2001), 8))


def _usual(moment: teaching.Moment) -> Array:
    """The mean picture of Third A."""
    assert isinstance(moment.policy, Imagines)
    return moment.policy.mean_pictures()[1]


def test_what_is_missing_is_imagined_and_held_against_its_camera(
    episode: list[teaching.Moment],
) -> None:
    found = imagined_at(episode[3], "third_b")
    assert list(found) == ["first", "third_a"]
    usual = _usual(episode[3])
    expected = moving_psnr(found["third_a"].picture, episode[3].arrived["third_a"], usual)
    assert found["third_a"].psnr == pytest.approx(expected)
    pair = imagined_sheet(episode[3], "first+third_b", size=84).pixels
    assert np.array_equal(pair[LABEL:, :84], episode[3].arrived["third_a"])


def test_the_imagined_is_nearer_than_the_mean_picture(episode: list[teaching.Moment]) -> None:
    usual = _usual(episode[0])
    control = np.mean([moving_psnr(usual, m.arrived["third_a"], usual) for m in episode])
    assert imagined_psnr(episode, "third_a", "first+third_b") > control + 3


def test_the_future_stands_below_what_happened(episode: list[teaching.Moment]) -> None:
    shown = foreseen_sheet(episode, 2, "first+third_b", "third_a", after=(1, 5), size=84).pixels
    assert np.array_equal(shown[LABEL : LABEL + 84, :84], episode[3].arrived["third_a"])
    assert np.array_equal(shown[LABEL : LABEL + 84, -84:], episode[7].arrived["third_a"])
    with pytest.raises(UserError, match="expected 6 decisions after step 2; begin earlier"):
        foreseen_sheet(episode, 2, "first", "third_a", after=(6,))


def test_who_cannot_imagine_says_so(episode: list[teaching.Moment]) -> None:
    with pytest.raises(UserError, match="imagines nothing from 'all'; drop a camera"):
        imagined_at(episode[0], "all")
    networks = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=16)
    plain = list(islice(teaching.moments(random_policy(toy_plan().spec, networks), seed=1), 3))
    with pytest.raises(UserError, match="imagines nothing from 'first'"):
        imagined_at(plain[0], "first")
    with pytest.raises(UserError, match="world model"):
        foreseen_sheet(plain, 0, "first", "third_a", after=(1,))
