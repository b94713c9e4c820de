"""The guard in a live session and on the page: what is shown is what the policy acts on."""

from __future__ import annotations

import re
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from madviz.app.panel import apply
from madviz.app.panels.comparison import ComparisonPanel
from madviz.app.panels.guard import GuardPanel, no_guard
from madviz.app.panels.policy import PolicyChoice
from madviz.app.panels.success import bars_html
from madviz.app.panels.words import WordsPanel
from madviz.app.success_rates import SuccessRates
from madviz.drawing.mosaic import mosaic
from madviz.envs.registry import make_env
from madviz.guard.fit import fit_values
from madviz.guard.policy import GuardedPolicy
from madviz.measure.guard_fit import play_intact
from madviz.observation.ablation import CameraState
from madviz.policies.guarded import fit_command, reference_to
from madviz.recording.facts import condition_words
from madviz.session.commands import Compare, Fork, Link, Scrub, SetCamera, SetPolicy
from madviz.session.guard_words import failing, guard_sentence
from madviz.session.replay import replay_episode
from madviz.types import Array, Encoded, Policy
from tests.fakes import FakePolicy, policies
from tests.pages import recorded, use
from tests.sessions import BLACK, OFF, Recorder, frame_with

NAME = "toy-mad"
GUARDED = f"guard:{NAME}"


@pytest.fixture(scope="module")
def guarded() -> GuardedPolicy:
    policy = FakePolicy(NAME)
    with closing(make_env("toy/reach", policy.spec.render_profile, policy.spec.cameras)) as env:
        episodes = [play_intact(policy, env, seed, True) for seed in range(900, 904)]
        places = env.spec.state_numbers.robot
    size = (policy.spec.image_size, policy.spec.image_size)
    return GuardedPolicy(policy, fit_values(episodes, size, places))


@pytest.fixture
def session(guarded: GuardedPolicy) -> Recorder:
    def load(name: str) -> Policy:
        return guarded if name.startswith("guard:") else policies(name)

    session = Recorder(FakePolicy(NAME), load=load)
    session.at(0.0)
    return session


def test_a_camera_that_fails_is_left_out_of_what_is_shown(session: Recorder) -> None:
    session.ask(SetPolicy(GUARDED))
    whole = session.steps(3)
    assert whole.mask.all() and failing(whole) == {}
    black = session.ask(SetCamera("first", BLACK))
    assert black.mask.tolist() == [False, True, True] and not black.uses("first")
    assert condition_words(black) == "all, First person sends black and is left out"
    noticed = failing(black)["first"]
    assert (noticed.kind, noticed.since, noticed.left_out) == ("black", 3, True)
    assert noticed.badge == "BLACK · left out since step 3"
    assert "First person sends black since step 3" in guard_sentence(black)
    dropped = session.ask(SetCamera("first", OFF))
    assert failing(dropped) == {}
    np.testing.assert_array_equal(dropped.action, black.action)
    assert not dropped.world.change or dropped.world.change.action_change == 0


def test_a_dropped_camera_is_imagined_without_one_that_fails(guarded: GuardedPolicy) -> None:
    class Painter(FakePolicy):
        """Draws a grey that tells which streams it drew from."""

        imagines = True

        def imagine(self, encoded: Encoded, mask: Array) -> Array:
            assert not isinstance(encoded.private, type(guarded.encode(views, state).private))
            return np.full((3, 84, 84, 3), 100 + int(mask @ [1, 2, 4]), np.uint8)

        def mean_pictures(self) -> Array:
            return np.zeros((3, 84, 84, 3), np.uint8)

    views = np.zeros((3, 9, 84, 84), np.uint8)
    state = np.zeros(4, np.float32)
    painter = GuardedPolicy(Painter(NAME), guarded.values)
    frame = frame_with(SetCamera("third_a", OFF), policy=painter)
    assert frame.world.imagined["third_a"].picture[0, 0, 0] == 105
    frame = frame_with(SetCamera("third_a", OFF), SetCamera("first", BLACK), policy=painter)
    assert list(frame.world.imagined) == ["third_a"]
    assert frame.world.imagined["third_a"].picture[0, 0, 0] == 104
    assert not guarded.imagines


def test_a_camera_is_imagined_from_the_pictures_that_are_acted_on(guarded: GuardedPolicy) -> None:
    """Where a failing camera cannot be left out, that is its last good picture."""

    class Needy(FakePolicy):
        imagines = True

        def supports(self, mask: Array) -> bool:
            return bool(mask[0])

        def imagine(self, encoded: Encoded, mask: Array) -> Array:
            drawn_from.append(encoded.features[0])
            return np.zeros((3, 84, 84, 3), np.uint8)

        def mean_pictures(self) -> Array:
            return np.zeros((3, 84, 84, 3), np.uint8)

    drawn_from: list[Array] = []
    session = Recorder(GuardedPolicy(Needy(NAME), guarded.values))
    session.at(0.0)
    session.steps(3)
    session.ask(SetCamera("third_a", OFF))
    good = drawn_from[-1]
    black = session.ask(SetCamera("first", BLACK))
    assert black.world.guard is not None and black.world.guard.failed == {"first"}
    of_black = session._stage._live.input.encoded.features[0]
    assert np.abs(drawn_from[-1] - good).max() < 0.5 * np.abs(of_black - good).max()


def test_the_shown_action_is_the_one_that_is_taken(session: Recorder) -> None:
    session.ask(SetPolicy(GUARDED), SetCamera("first", BLACK))
    shown = session.frames[-1].action
    session.steps(1)
    taken = session._stage._live.snapshot().actions[-1]
    np.testing.assert_allclose(taken, shown, atol=1e-6)


def test_looking_at_a_step_again_is_no_step_of_the_guard(session: Recorder) -> None:
    """Each touch of a camera asks the guard anew; a confirmed kind must not come sooner."""
    session.ask(SetPolicy(GUARDED))
    session.steps(2)
    for state in (BLACK, CameraState("rgb"), BLACK, CameraState("rgb")):
        frame = session.ask(SetCamera("first", state))
    assert failing(frame) == {} and frame.world.guard is not None
    assert frame.world.guard.step == 2


def test_a_guard_that_begins_late_counts_the_steps_of_the_episode(session: Recorder) -> None:
    session.ask(SetCamera("third_a", BLACK))
    session.steps(5)
    frame = session.ask(SetPolicy(GUARDED))
    assert failing(frame)["third_a"].since == 5
    session.ask(SetPolicy(NAME))
    assert session.frames[-1].world.guard is None


def test_going_back_and_replaying_find_the_same(session: Recorder, guarded: GuardedPolicy) -> None:
    session.ask(SetPolicy(GUARDED))
    session.steps(2)
    session.ask(SetCamera("first", BLACK))
    session.steps(4)
    frame = session.ask(Scrub(4), Fork())
    assert failing(frame)["first"].since == 2 and not frame.pace.error
    later = session.steps(2)
    assert failing(later)["first"].since == 2
    saved = session.save().episodes[-1]
    again = replay_episode(
        saved, lambda policy: guarded if "(guarded)" in policy.name else FakePolicy(NAME)
    )
    assert again.sha256 == saved.sha256


def test_a_file_names_the_policy_with_its_guard() -> None:
    assert reference_to("toy-mad (guarded)") == GUARDED
    assert reference_to(NAME) == NAME


def test_the_page_says_it(session: Recorder, server) -> None:
    session.ask(SetPolicy(GUARDED))
    session.steps(1)
    before = mosaic(session.frames[-1], 150)
    frame = session.ask(SetCamera("first", BLACK))
    assert mosaic(frame, 150)[-20:, :150].max() > 200, "a badge over the black picture"
    assert before.shape == mosaic(frame, 150).shape
    panel = WordsPanel(server.gui, frame, SuccessRates())
    assert "First person sends black since step 1" in panel._content(frame)
    assert re.search("with guard · [^<]*black", bars_html(frame, SuccessRates()))
    without = session.ask(SetPolicy(NAME))
    assert "with guard" not in bars_html(without, SuccessRates())


def test_the_switch_wraps_the_policy_that_acts(session: Recorder, server, monkeypatch) -> None:
    monkeypatch.setattr("madviz.app.panels.guard.has_guard", lambda policy: True)
    sent: list = []
    gui = recorded(server.gui)
    panel = GuardPanel(gui, sent.append, session.frames[-1])
    apply(panel.update(session.frames[-1]))
    switch = gui.find("Guard")
    assert not switch.disabled and switch.value is False
    use(switch, True)
    assert sent == [SetPolicy(GUARDED)]
    frame = session.ask(*sent)
    apply(panel.update(frame))
    assert switch.value is True
    paired = session.ask(Compare(GUARDED, frame.world.ablation))
    apply(panel.update(paired))
    sent.clear()
    use(switch, False)
    assert sent == [SetPolicy(NAME), Compare(NAME, frame.world.ablation), Link(True)]
    panel.remove()


def test_the_command_names_the_recordings_of_a_policy() -> None:
    command = "madviz guard --policy my-mad"
    assert fit_command("my-mad", "metaworld/hammer") == command
    assert fit_command("my-mad", "recording/bench") == f"{command} --recording bench"
    assert no_guard("ws://127.0.0.1:1", "toy/reach").endswith("a folder can have a guard.")


def test_without_values_the_switch_names_the_command(server) -> None:
    gui = recorded(server.gui)
    panel = GuardPanel(gui, lambda _: None, frame_with())
    apply(panel.update(frame_with()))
    assert gui.find("Guard").disabled
    assert f"madviz guard --policy {frame_with().world.policy.name}" in gui.html
    watched = GuardPanel(gui, None, replace(frame_with()))
    assert gui.find("Guard", 1).disabled
    watched.remove()
    panel.remove()


def test_b_gets_the_guard_that_a_has(session: Recorder, server, monkeypatch) -> None:
    fitted = [True, False]
    monkeypatch.setattr("madviz.app.panels.comparison.has_guard", lambda _: fitted.pop(0))
    sent: list = []
    gui = recorded(server.gui)
    choices = [PolicyChoice(NAME, NAME, "toy/reach")]
    panel = ComparisonPanel(gui, sent.append, session.frames[-1], choices)
    use(gui.find("start B"))
    apply(panel.update(session.ask(SetPolicy(GUARDED))))
    use(gui.find("start B"))
    use(gui.find("start B"))  # Nobody has fitted its guard.
    assert [one.policy for one in sent] == [NAME, GUARDED, NAME]
    panel.remove()


def test_the_bars_say_which_side_has_the_guard(session: Recorder) -> None:
    frame = session.ask(SetPolicy(GUARDED), Compare(NAME))
    assert "no guard" in bars_html(frame, SuccessRates())
    both = session.ask(Compare(GUARDED))
    assert "no guard" not in bars_html(both, SuccessRates())
    only_b = bars_html(session.ask(SetPolicy(NAME)), SuccessRates())
    assert only_b.index("<b>A</b>") < only_b.index(">with guard<") < only_b.index("<b>B</b>")
