"""Dropped and occluded are two things; occlusions are pure and repeat from their seed."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.observation.ablation import (
    Ablation,
    CameraState,
    Occlusion,
    OcclusionKind,
    by_sides,
    noise_generator,
)
from madviz.observation.condition import Condition
from madviz.subsets import every_mask, mask_of, name_of

FRAME = np.random.default_rng(0).integers(0, 256, (84, 84, 3), np.uint8)
BEFORE = np.full_like(FRAME, 7)


def arrive(occlusion: Occlusion, frame: np.ndarray = FRAME) -> np.ndarray:
    before = BEFORE[..., : frame.shape[2]]
    return occlusion.apply(frame, before, noise_generator(1, 2, "first"))


@pytest.mark.parametrize("kind", get_args(OcclusionKind))
@pytest.mark.parametrize("channels", [3, 1])
def test_every_kind_keeps_shape_and_input(kind: str, channels: int) -> None:
    frame = FRAME[..., :channels].copy()
    kept = frame.copy()
    arrived = arrive(Occlusion(kind), frame)  # type: ignore[arg-type]
    assert arrived.shape == frame.shape and arrived.dtype == np.uint8
    assert np.array_equal(frame, kept)
    same = kind in ("none", "delay", "mean") or (kind == "light" and channels == 1)
    assert np.array_equal(arrived, frame) == same


def test_what_arrives() -> None:
    assert not arrive(Occlusion("black")).any()
    assert np.array_equal(arrive(Occlusion("freeze")), BEFORE)
    noisy = arrive(Occlusion("noise", strength=1.0))
    assert np.array_equal(noisy, arrive(Occlusion("noise", strength=1.0)))
    assert np.abs(arrive(Occlusion("noise", strength=0.1)).astype(int) - FRAME).mean() < 12
    assert arrive(Occlusion("blur")).std() < FRAME.std() / 4


def test_light_is_a_factor_and_half_of_it_changes_nothing() -> None:
    assert np.array_equal(arrive(Occlusion("light", 0.5)), FRAME)
    darker = arrive(Occlusion("light", 0.15))
    assert np.abs(darker - 0.3 * FRAME.astype(float)).max() <= 0.5
    assert arrive(Occlusion("light", 1.0)).max() == 255
    assert Occlusion("light", 0.15).badge == "LIGHT x0.3"


def test_lost_pictures_repeat_the_last_one_and_depend_on_seed_step_and_stream() -> None:
    def lost(seed: int, stream: str, strength: float = 0.3) -> list[bool]:
        arrived = [
            Occlusion("dropout", strength).apply(FRAME, BEFORE, noise_generator(seed, step, stream))
            for step in range(300)
        ]
        assert all(np.array_equal(one, FRAME) or np.array_equal(one, BEFORE) for one in arrived)
        return [np.array_equal(one, BEFORE) for one in arrived]

    assert 60 < sum(lost(1, "first")) < 120
    assert lost(1, "first") == lost(1, "first")
    assert lost(1, "first") != lost(2, "first") != lost(1, "third_a")
    assert not any(lost(1, "first", 0.0)) and all(lost(1, "first", 1.0))
    first = Occlusion("dropout").apply(FRAME, None, noise_generator(1, 0, "first"))
    assert np.array_equal(first, FRAME)


def test_noise_differs_between_steps_and_streams() -> None:
    draws = [
        Occlusion("noise").apply(FRAME, None, noise_generator(*key)).tobytes()
        for key in ((1, 2, "first"), (1, 3, "first"), (2, 2, "first"), (1, 2, "third_a"))
    ]
    assert len(set(draws)) == 4


def test_a_patch_is_where_it_was_put() -> None:
    patched = arrive(Occlusion("patch", x=0.25, y=0.75, width=0.5, height=0.25))
    assert not patched[52:74, :42].any()
    for left in (np.s_[:52], np.s_[74:], np.s_[:, 42:]):
        assert np.array_equal(patched[left], FRAME[left]) and FRAME[left].any()
    outside = arrive(Occlusion("patch", x=1.0, y=1.0, width=0.2, height=0.2))
    assert not outside[76:, 76:].any() and outside[:70].any()
    assert not arrive(Occlusion("patch", width=1.0, height=1.0)).any()


def test_a_size_is_a_square() -> None:
    assert by_sides({"x": 0.1, "size": 0.3}) == {"x": 0.1, "width": 0.3, "height": 0.3}
    assert by_sides({"width": 0.3}) == {"width": 0.3}
    with pytest.raises(UserError, match="drop the size"):
        by_sides({"size": 0.3, "height": 0.4})


@pytest.mark.parametrize(
    "bad",
    [
        {"strength": 1.5},
        {"x": -0.1},
        {"width": float("nan")},
        {"height": 1.01},
        {"kind": "rain"},
        {"height": "0.4"},
        {"width": -0.1},
    ],
)
def test_absurd_values_are_refused(bad: dict) -> None:
    with pytest.raises(UserError):
        Occlusion(**{"kind": "patch", **bad})


@pytest.mark.parametrize("setting", ["three", "three-rgbd"])
def test_masks_and_switches_say_the_same(setting: str) -> None:
    streams = SETTINGS[setting].streams
    for mask in every_mask(len(streams)):
        condition = Condition(name_of(mask, streams), (("first", Occlusion("black")),))
        ablation = condition.ablation(streams)
        assert np.array_equal(ablation.mask(streams), mask)
        assert ablation.occlusions() == {"first": Occlusion("black")}


def test_switches_of_a_camera() -> None:
    rgbd = SETTINGS["three-rgbd"].streams
    ablation = Ablation({"first": CameraState("off"), "third_a": CameraState("depth")})
    assert np.array_equal(ablation.mask(rgbd), mask_of("third_a.depth+third_b", rgbd))
    plain = ablation.mask(SETTINGS["three"].streams)
    assert plain.tolist() == [False, False, True]  # RGB-only: depth alone leaves nothing.


def occluded(occlusion: Occlusion) -> Condition:
    """All cameras, the first of which fails."""
    return Condition("all", (("first", occlusion),))


@pytest.mark.parametrize("kind", get_args(OcclusionKind))
def test_what_a_kind_does_not_use_is_no_part_of_a_condition(kind: OcclusionKind) -> None:
    plain, left_over = Occlusion(kind), Occlusion(kind, x=0.1, y=0.2, width=0.3, height=0.6)
    streams = SETTINGS["three"].streams
    keys = {occluded(one).noticed(streams).key() for one in (plain, left_over)}
    assert len(keys) == 1 + (kind == "patch")
    weaker = Occlusion(kind, strength=0.5)
    states = [Ablation({"first": CameraState("rgb", one)}) for one in (plain, weaker)]
    same = kind in ("none", "black", "mean", "freeze")
    assert (Condition.of(states[0], streams) == Condition.of(states[1], streams)) is same
    noticed = [occluded(one).noticed(streams) for one in (plain, weaker)]
    assert (noticed[0] == noticed[1]) is same
    if kind != "none":  # The words that results were stored under are found again.
        assert keys >= {f"first:{kind},strength=1,x=0.5,y=0.5,size=0.4"}


def test_pictures_that_come_equally_late_are_one_condition() -> None:
    late = [occluded(Occlusion("delay", strength)) for strength in (0.28, 0.3, 0.31)]
    keys = {condition.noticed(SETTINGS["three"].streams).key() for condition in late}
    assert keys == {"first:delay,strength=0.3,x=0.5,y=0.5,size=0.4"}


def test_a_key_names_occlusions_and_nothing_else() -> None:
    streams = SETTINGS["three"].streams
    assert Condition.of(Ablation({"first": CameraState("off")}), streams).key() == ""
    patches = [
        Occlusion("patch", width=w, height=h) for w, h in ((0.4, 0.4), (0.4, 0.3), (0.3, 0.4))
    ]
    keys = [occluded(patch).noticed(streams).key() for patch in patches]
    assert len(set(keys)) == 3
    # As squares were named before patches had two sides: stored results are found again.
    assert keys[0] == "first:patch,strength=1,x=0.5,y=0.5,size=0.4"
    assert keys[1] == "first:patch,strength=1,x=0.5,y=0.5,width=0.4,height=0.3"
