"""The language of camera subsets."""

from __future__ import annotations

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.subsets import every_mask, mad_subsets, mask_of, name_of, single_streams

THREE = SETTINGS["three"].streams
RGBD = SETTINGS["three-rgbd"].streams


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("all", "111111"),
        ("none", "000000"),
        ("rgb", "101010"),
        ("depth", "010101"),
        ("first", "110000"),
        ("first+third_a.depth", "110100"),
        ("third_b.depth", "000001"),
        ("rgb+first.depth", "111010"),
    ],
)
def test_names_to_masks(name: str, expected: str) -> None:
    assert "".join(map(str, mask_of(name, RGBD).astype(int))) == expected


@pytest.mark.parametrize("streams", [THREE, RGBD, ("first", "first.depth", "third_a")])
def test_every_mask_has_a_name_that_leads_back(streams: tuple[str, ...]) -> None:
    masks = every_mask(len(streams))
    names = [name_of(mask, streams) for mask in masks]
    assert len(set(names)) == len(masks) == 2 ** len(streams)
    assert names[0] == "all" and names[-1] == "none"
    for name, mask in zip(names, masks, strict=True):
        assert np.array_equal(mask_of(name, streams), mask)


def test_an_unknown_word_lists_the_known_ones() -> None:
    with pytest.raises(UserError, match=r"unknown camera subset 'fourth'.*third_a"):
        mask_of("first+fourth", THREE)


def test_what_mad_trains() -> None:
    assert mad_subsets(THREE) == single_streams(THREE) == THREE
    assert set(mad_subsets(RGBD)) == {"rgb", "depth", *THREE, *RGBD}
    assert mad_subsets(SETTINGS["one-rgbd"].streams) == ("rgb", "depth")


@pytest.mark.parametrize("streams", [setting.streams for setting in SETTINGS.values()])
def test_the_merge_is_never_a_singular_subset(streams: tuple[str, ...]) -> None:
    assert not any(mask_of(name, streams).all() for name in mad_subsets(streams))


def test_names_are_the_shortest_honest_ones() -> None:
    assert name_of(np.array([1, 0, 1], bool), THREE) == "first+third_b"
    assert name_of(mask_of("first.rgb+first.depth", RGBD), RGBD) == "first"
