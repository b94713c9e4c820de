"""The guard: what it notices on the table of cases, its values, and the policy that it wraps."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from madviz.errors import UserError
from madviz.guard.detector import Guard
from madviz.guard.fit import blank_steps, blind_streams, fit_values, seen_episode
from madviz.guard.pictures import sums_of
from madviz.guard.policy import GuardedPolicy, guard_note
from madviz.guard.values import LARGEST, GuardValues, read_values, write_values
from madviz.types import Array, Encoded, PolicySpec, Readout
from tests import guard_scene as scene

CASES = json.loads(scene.CASES.read_text())
VALUES = msgspec.convert(CASES["values"], GuardValues)
STREAMS = ("first", "third_a", "third_b")
NAMES = [case["name"] for case in CASES["cases"]]
NOTICED = {
    "black from step 0": ("black", 0),
    "gone for a while": ("gone", 20),
    "noise": ("noise", 5),
    "covered": ("covered", 6),  # Confirmed: the second picture.
    "blurred": ("blurred", 6),
    "frozen from step 0": ("frozen", 1),
    "frozen for a while": ("frozen", 20),
    "late from step 20": ("late", 20),
}


def values_for(streams: tuple[str, ...]) -> GuardValues:
    return msgspec.structs.replace(VALUES, streams=dict.fromkeys(streams, VALUES.streams["camera"]))


@pytest.mark.parametrize("case", CASES["cases"], ids=NAMES)
def test_the_verdict_on_every_step_of_the_table(case: dict) -> None:
    assert scene.SHOWS[case["name"]] == case["shows"]
    assert scene.verdicts(VALUES, case["walk"], case["shows"]) == case["kinds"]


@pytest.mark.parametrize("name", NOTICED)
def test_a_failure_is_noticed_at_once(name: str) -> None:
    kinds = CASES["cases"][NAMES.index(name)]["kinds"]
    kind, step = NOTICED[name]
    assert kinds[:step] == ["fine"] * step and kinds[step] == kind


def test_the_numbers_of_pictures() -> None:
    pictures = [scene.picture((21, 21)), scene.shown("noise", scene.walk(1), 3)]
    for picture, expected in zip(pictures, CASES["sums"], strict=False):
        assert picture is not None
        sums = sums_of(picture)
        assert sums.cells[:24].tolist() == expected["cells"]
        assert int(sums.cells.sum()) == expected["sum"] == int(picture.sum())
        assert sums.spread == pytest.approx(float(sums.cells.std()), abs=1e-6)
        assert [sums.dark, sums.rough, sums.edges] == [
            expected["dark"],
            expected["rough"],
            expected["edges"],
        ]


def test_how_well_each_lag_agrees() -> None:
    table = CASES["lags"]
    found = scene.agreements(VALUES, table["walk"], table["steps"])
    assert found == pytest.approx(table["agreements"], abs=1e-9)
    assert int(np.argmax(found)) <= 1


@pytest.mark.parametrize("seed", range(200, 220))
def test_intact_cameras_raise_no_alarm(seed: int) -> None:
    steps: list[scene.Show] = list(range(scene.STEPS))
    assert set(scene.verdicts(VALUES, seed, steps)) == {"fine"}


def test_a_robot_that_stands_is_no_frozen_camera() -> None:
    guard = Guard(VALUES)
    picture = scene.picture((20, 20))
    still = [guard.step({"camera": picture}, scene.state((20, 20)))["camera"] for _ in range(30)]
    assert all(verdict.fine for verdict in still)
    moved = guard.step({"camera": picture}, scene.state((21, 20)))["camera"]
    assert (moved.kind, moved.since) == ("frozen", 30)


def trembling(seed: int, stand: range) -> tuple[list[Array], Array]:
    """Pictures, and states (T, 4): where the hand is and was, and a joint that trembles. The hand
    stands at the steps of ``stand``."""
    places = scene.walk(seed)
    places = [places[min(step, stand.start)] for step in range(stand.stop)] + places[stand.start :]
    before = [places[0], *places[:-1]]
    joint = np.array([0.1 * (number % 3 - 1) for number in scene.draws(seed, len(places))])
    states = [[*now, *was, size] for now, was, size in zip(places, before, joint, strict=True)]
    return [scene.picture(place) for place in places], np.array(states, np.float64)


def test_what_changes_behind_equal_pictures_is_no_movement() -> None:
    fitted = []
    for seed in range(8):
        pictures, states = trembling(seed, range(20, 35))
        fitted.append(seen_episode([{"camera": one} for one in pictures], states))
    values = fit_values(fitted, (42, 42))
    alarms = []
    for seed in range(300, 310):
        guard = Guard(values)
        for picture, state in zip(*trembling(seed, range(10, 30)), strict=True):
            alarms.append(guard.step({"camera": picture}, state)["camera"].kind)
    assert set(alarms) == {"fine"}
    frozen = Guard(values)
    pictures, states = trembling(300, range(10, 12))
    kinds = [frozen.step({"camera": pictures[5]}, state)["camera"].kind for state in states[5:9]]
    assert kinds == ["fine", "frozen", "frozen", "frozen"], "where the hand moves, it still counts"


def test_lateness_is_read_from_movements_where_no_picture_repeats() -> None:
    """The camera was late before the guard looked, so the table's repeats are missing."""
    found = 0
    for seed in range(300, 310):
        places = scene.walk(seed)
        guard = Guard(VALUES)
        for step in range(5, scene.STEPS):
            pictures = {"camera": scene.picture(places[step - 5])}
            verdict = guard.step(pictures, scene.state(places[step]))["camera"]
        found += verdict.kind == "late"
    assert found >= 8


def test_a_late_camera_whose_lateness_cannot_be_read_is_used_after_it_was_gone() -> None:
    mute = msgspec.structs.replace(VALUES.streams["camera"], numbers=(), scales=(), weights="")
    values = msgspec.structs.replace(VALUES, streams={"camera": mute})
    shows = scene.late(5, 20)
    shows = [*shows[:30], "gone", *range(31, scene.STEPS)]
    kinds = scene.verdicts(values, 100, shows)
    assert kinds[29:31] == ["late", "gone"] and set(kinds[33:]) == {"fine"}
    assert "fine" not in scene.verdicts(VALUES, 100, shows)[30:40], (
        "where it can be read, it has to"
    )


def test_a_stream_that_was_not_watched_begins_anew() -> None:
    guard = Guard(VALUES)
    places = scene.walk(5)
    guard.step({"camera": None}, scene.state(places[0]))
    assert guard.step({}, scene.state(places[1])) == {}
    assert guard.step({"camera": scene.picture(places[2])}, scene.state(places[2]))["camera"].fine


@pytest.mark.parametrize(
    ("pictures", "state", "words"),
    [
        ({"other": None}, np.zeros(2), "found 'other'"),
        ({"camera": np.zeros((21, 21, 3), np.uint8)}, np.zeros(2), "expected pictures of 42 by 42"),
        ({"camera": np.zeros((42, 42, 3))}, np.zeros(2), "uint8"),
        ({"camera": None}, np.zeros(1), "2 finite numbers"),
        ({"camera": None}, np.array([0, np.nan]), "2 finite numbers"),
    ],
)
def test_what_is_no_picture_or_state_is_refused(pictures: dict, state: Array, words: str) -> None:
    with pytest.raises(UserError, match=words):
        Guard(VALUES).step(pictures, state)


def test_values_are_small_and_come_back(tmp_path) -> None:
    six = values_for(tuple(f"camera{number}" for number in range(6)))
    write_values(tmp_path / "guard.json", six)
    assert (tmp_path / "guard.json").stat().st_size < LARGEST
    assert read_values(tmp_path / "guard.json", "fit") == six
    assert six.digest != VALUES.digest


def test_values_that_are_missing_or_broken_name_the_command(tmp_path) -> None:
    with pytest.raises(UserError, match="found none; run `madviz guard --policy P`"):
        read_values(tmp_path / "guard.json", "madviz guard --policy P")
    stream = msgspec.structs.replace(VALUES.streams["camera"], weights="AAAA")
    write_values(tmp_path / "g.json", msgspec.structs.replace(VALUES, streams={"first": stream}))
    with pytest.raises(UserError, match="weights for each number of first"):
        read_values(tmp_path / "g.json", "fit")


@pytest.mark.parametrize(
    ("changed", "of_stream"),
    [
        ({"unit": (0.0, 1.0)}, {}),
        ({"unit": (1.0,)}, {}),
        ({"state": (-1, 0)}, {}),
        ({"state": (), "unit": ()}, {"reach": (), "numbers": (), "scales": (), "weights": ""}),
        ({"schema": 1}, {}),
        ({}, {"numbers": (0, 9)}),
        ({}, {"scales": (1.0, 1.0, 1.0)}),
        ({}, {"reach": (0.1,)}),
    ],
)
def test_values_that_do_not_fit_together_are_refused(
    changed: dict, of_stream: dict, tmp_path
) -> None:
    stream = msgspec.structs.replace(VALUES.streams["camera"], **of_stream)
    values = msgspec.structs.replace(VALUES, **{"streams": {"first": stream}, **changed})
    write_values(tmp_path / "g.json", values)
    with pytest.raises(UserError, match="run `fit`"):
        read_values(tmp_path / "g.json", "fit")


def test_fitting_refuses_too_little() -> None:
    with pytest.raises(UserError, match="4 episodes or more"):
        fit_values([scene.episode(1)], (42, 42))
    still = seen_episode([{"camera": scene.picture((20, 20))}] * 9, np.zeros((9, 2)))
    with pytest.raises(UserError, match="robot moves"):
        fit_values([still] * 4, (42, 42))
    with pytest.raises(UserError, match="places in a state of 2 numbers, found 2"):
        fit_values([scene.episode(seed) for seed in range(4)], (42, 42), state=(0, 2))


def test_episodes_that_do_not_fit_each_other_are_named() -> None:
    good = [scene.episode(seed) for seed in range(4)]
    sums = good[0].sums["camera"]
    odd = {
        r"pictures of \(42, 42\).*found \(21, 42\) in episode 2": {"size": (21, 42)},
        "camera and 2 .*found wrist and 2 in episode 2": {"sums": {"wrist": sums}},
        "found camera and 3 in episode 2": {"states": np.zeros((len(sums), 3))},
    }
    for words, change in odd.items():
        with pytest.raises(UserError, match=words):
            fit_values([*good[:2], replace(good[2], **change), good[3]], (42, 42))
    with pytest.raises(UserError, match=r"pictures of \(100, 60\)"):
        fit_values(good, (100, 60))
    with pytest.raises(UserError, match="state of 2 numbers, found -1"):
        fit_values(good, (42, 42), state=(-1,))
    sizes = [{"camera": np.zeros((size, 42, 3), np.uint8)} for size in (42, 21)]
    with pytest.raises(UserError, match="pictures of one size"):
        seen_episode(sizes, np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("pictures", "states", "words"),
    [
        (["camera"] * 3, np.zeros((2, 2)), r"each of 3 steps, found states of shape \(2, 2\)"),
        (["camera"] * 3, np.full((3, 2), np.nan), "finite numbers"),
        (["camera", "other"], np.zeros((2, 2)), "the same streams at every step"),
        ([], np.zeros((0, 2)), "the same streams"),
    ],
)
def test_an_episode_has_all_of_every_step(pictures: list, states: Array, words: str) -> None:
    shown = [{name: scene.picture((20, 20))} for name in pictures]
    with pytest.raises(UserError, match=words):
        seen_episode(shown, states)


def test_a_picture_that_shows_nothing_of_the_robot_gives_no_weights() -> None:
    episodes = []
    for seed in range(8):
        states = np.array([scene.state(place) for place in scene.walk(seed)])
        others = [{"camera": scene.picture(place)} for place in scene.walk(seed + 50)]
        episodes.append(seen_episode(others, states))
    assert fit_values(episodes, (42, 42)).streams["camera"].numbers == ()


def test_a_black_picture_among_those_that_are_fitted_switches_nothing_off() -> None:
    size = (42, 42)
    black = sums_of(np.zeros((*size, 3), np.uint8))
    episodes = [scene.episode(seed) for seed in range(8)]
    sums = episodes[5].sums["camera"]
    warm = (black, *sums[1:30], black, *sums[31:])
    fitted = [*episodes[:5], replace(episodes[5], sums={"camera": warm}), *episodes[6:]]
    assert blank_steps(fitted, size) == {"camera": [(5, 0), (5, 30)]}
    values = fit_values(fitted, size)
    for name in ("black from step 0", "covered", "blurred"):
        kinds = CASES["cases"][NAMES.index(name)]["kinds"]
        assert scene.verdicts(values, 100, scene.SHOWS[name]) == kinds
    dark = [replace(one, sums={"camera": (black,) * len(sums)}) for one in episodes]
    assert blank_steps(dark, size) == {"camera": []}, "black is what this stream shows"
    assert blind_streams(dark, size) == ["camera"] and blind_streams(fitted, size) == []
    shows = fit_values(dark, size)
    assert shows.streams["camera"].dark == 441
    works = Guard(shows).step({"camera": scene.picture((20, 20))}, np.zeros(2))["camera"]
    assert works.why.endswith("; 0 or less is usual"), "its roughness was 0"
    short = [seen_episode([{"camera": np.zeros((*size, 3), np.uint8)}] * 5, np.zeros((5, 2)))] * 5
    with pytest.raises(UserError, match="in which camera shows something, found 3"):
        fit_values([*episodes[:3], *short], size)


def test_the_guard_needs_no_torch() -> None:
    code = "import sys, madviz.guard.policy, madviz.guard.fit; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# --- The wrapped policy ---------------------------------------------------------------------


class MaskPolicy:
    """Its action is the mask, and the brightness of every stream that it was given."""

    def __init__(self, needs: tuple[str, ...] = (), streams: tuple[str, ...] = STREAMS) -> None:
        self.spec = PolicySpec("p", "toy/reach", "mad", "three", "none", streams, ("all",))
        self.spec = replace(self.spec, digest="d")
        self._needed = np.array([stream in needs for stream in streams])

    def encode(self, views: Array, state: Array) -> Encoded:
        return Encoded(views.mean((1, 2, 3))[:, None].astype(np.float32), state)

    def read(self, encoded: Encoded, masks: Array) -> Readout:
        action = np.concatenate([masks, masks * encoded.features[:, 0]], axis=1)
        return Readout(masks @ encoded.features, action, np.zeros(len(masks)))

    def supports(self, mask: Array) -> bool:
        return bool(mask[self._needed].all())


def play(
    policy: GuardedPolicy, shows: dict[str, list[scene.Show]], steps: int = 12
) -> list[tuple[list[bool], list[float], str]]:
    """The streams that the policy acted on, the brightness it saw, and the note, at every step."""
    places = scene.walk(100)
    player = policy.reset(0)
    found = []
    streams = policy.spec.streams
    for step in range(steps):
        views = []
        for stream in streams:
            picture = scene.shown(shows[stream][step], places, step)
            assert picture is not None
            views.append(np.concatenate([picture.transpose(2, 0, 1)] * 3))
        encoded = policy.encode(np.stack(views), scene.state(places[step]))
        action = player.act(encoded, np.ones(len(streams), bool))
        mask = action[: len(streams)] > 0
        assert mask.tolist() == player.report.mask.tolist()
        found.append((mask.tolist(), action[len(streams) :].tolist(), player.report.note))
    return found


INTACT = scene.from_step(scene.STEPS, None)
BLACK = scene.from_step(3, "black", 6)


def test_a_failing_camera_is_left_out_and_used_again() -> None:
    policy = GuardedPolicy(MaskPolicy(), values_for(STREAMS))
    steps = play(policy, {"first": BLACK, "third_a": INTACT, "third_b": INTACT})
    masks = [mask for mask, _, _ in steps]
    left_out = [False, True, True]
    assert masks == [[True] * 3] * 3 + [left_out] * 5 + [[True] * 3] * 4
    assert steps[3][2] == "first left out" and steps[9][2] == ""


def test_two_cameras_and_all_of_them() -> None:
    policy = GuardedPolicy(MaskPolicy(), values_for(STREAMS))
    frozen = scene.from_step(5, 4)
    steps = play(policy, {"first": BLACK, "third_a": frozen, "third_b": INTACT})
    assert steps[5][0] == [False, False, True]
    steps = play(policy, {"first": BLACK, "third_a": BLACK, "third_b": BLACK})
    assert steps[4][0] == [False] * 3 and "no camera is left" in steps[4][2]


def test_a_camera_fails_with_all_its_streams() -> None:
    streams = ("first.rgb", "first.depth", "third_a.rgb", "third_a.depth")
    policy = GuardedPolicy(MaskPolicy(streams=streams), values_for(streams))
    shows = dict.fromkeys(streams, INTACT) | {"first.depth": BLACK}
    assert play(policy, shows)[4][0] == [False, False, True, True]


def test_cameras_of_ones_own_have_a_guard_too() -> None:
    streams = ("left", "wrist")
    policy = GuardedPolicy(MaskPolicy(streams=streams), values_for(streams))
    assert play(policy, {"left": INTACT, "wrist": BLACK})[4][0] == [True, False]
    with pytest.raises(UserError, match="found none for left; run `madviz guard --policy p`"):
        GuardedPolicy(MaskPolicy(streams=streams), values_for(STREAMS))


def test_a_stream_that_never_changes_can_be_fitted() -> None:
    """For example, the depth of an empty wall."""
    episodes = []
    for seed in range(4):
        states = np.array([scene.state(place) for place in scene.walk(seed)])
        episodes.append(seen_episode([{"camera": scene.picture((20, 20))}] * len(states), states))
    values = fit_values(episodes, (42, 42)).streams["camera"]
    assert values.numbers == () and min(values.reach) > 0


def test_where_it_cannot_be_left_out_the_last_good_picture_stands_in() -> None:
    policy = GuardedPolicy(MaskPolicy(needs=("first",)), values_for(STREAMS))
    steps = play(policy, {"first": BLACK, "third_a": INTACT, "third_b": INTACT})
    assert steps[4][0] == [True] * 3
    assert steps[4][1][0] == steps[2][1][0] > 0
    assert steps[4][2] == "p cannot leave out first: the last good picture stands in"
    always = scene.from_step(0, "black")
    steps = play(policy, {"first": always, "third_a": INTACT, "third_b": INTACT})
    assert "first has none and is used as it comes" in steps[0][2]


@pytest.mark.parametrize("way", ["covered", "blurred"])
def test_a_bad_picture_never_stands_in(way: str) -> None:
    """These kinds are noticed at their second picture."""
    policy = GuardedPolicy(MaskPolicy(needs=("first",)), values_for(STREAMS))
    shows = {"first": scene.from_step(3, way), "third_a": INTACT, "third_b": INTACT}
    steps = play(policy, shows)
    assert steps[3][1][0] != steps[2][1][0] == steps[4][1][0] == steps[11][1][0]


def test_what_stands_in_is_a_copy() -> None:
    policy = GuardedPolicy(MaskPolicy(needs=STREAMS), values_for(STREAMS))
    player = policy.reset(0)
    views = np.tile(scene.picture(scene.walk(100)[0]).transpose(2, 0, 1), (3, 3, 1, 1))
    state = scene.state(scene.walk(100)[0])
    bright = player.act(policy.encode(views, state), np.ones(3, bool))
    views[:] = 0
    assert (player.act(policy.encode(views, state), np.ones(3, bool)) == bright).all()


def test_only_what_is_needed_stands_in() -> None:
    policy = GuardedPolicy(MaskPolicy(needs=("first",)), values_for(STREAMS))
    always = scene.from_step(0, "black")
    steps = play(policy, {"first": scene.from_step(5, "black"), "third_a": always,
                          "third_b": INTACT})  # fmt: skip
    assert steps[4] == ([True, False, True], steps[4][1], "third_a left out")
    mask, brightness, note = steps[5]
    assert mask == [True, False, True] and brightness[0] == steps[4][1][0]
    assert note == ("third_a left out; p cannot leave out first: the last good picture stands in")


def test_or_the_episode_stops() -> None:
    policy = GuardedPolicy(MaskPolicy(needs=("first",)), values_for(STREAMS), instead="stop")
    with pytest.raises(UserError, match="found first failing"):
        play(policy, {"first": BLACK, "third_a": INTACT, "third_b": INTACT})


def test_what_a_guard_does_is_said() -> None:
    assert guard_note(MaskPolicy()) == ""
    assert guard_note(GuardedPolicy(MaskPolicy(), values_for(STREAMS))).endswith("works again.")
    needs = GuardedPolicy(MaskPolicy(needs=("first",)), values_for(STREAMS))
    assert "not possible (first), its last good picture stands in" in guard_note(needs)


def test_a_guard_is_another_policy_for_the_store_and_needs_all_streams() -> None:
    inner = MaskPolicy()
    policy = GuardedPolicy(inner, values_for(STREAMS))
    other = GuardedPolicy(inner, values_for((*STREAMS, "more")))
    assert len({inner.spec.digest, policy.spec.digest, other.spec.digest}) == 3
    with pytest.raises(UserError, match="found none for third_b; run"):
        GuardedPolicy(inner, values_for(STREAMS[:2]))
