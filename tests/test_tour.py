"""The guided tour: what each step does to a real session, and that nothing of it stays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import viser

from madviz.app.panels.policy import PolicyChoice
from madviz.app.tour import HELP, Tour
from madviz.app.tour_steps import GOES_AT, acts, comparison_steps, steps
from madviz.envs.registry import make_env
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.observation.schedule import Event
from madviz.policies.seeds import FIRST_DEVELOPMENT
from madviz.session.commands import (
    Compare,
    Link,
    Pause,
    Play,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
    SetSpeed,
    StepOnce,
)
from madviz.session.frame import Frame
from madviz.session.session import Session
from tests.fakes import FakePolicy
from tests.pages import browser, use
from tests.sessions import with_world

PAIR = {
    "toy-mad-light": FakePolicy("toy-mad-light"),
    "toy-merged-only-light": FakePolicy("toy-merged-only-light", method="merged-only", seed=1),
}
CHOICES = [PolicyChoice(name, name) for name in PAIR]


class Table:
    """A session that ticks when a test says so."""

    def __init__(self) -> None:
        self.now = 0.0
        self.session = Session(make_env, PAIR["toy-mad-light"], PAIR.__getitem__)
        self.tick()

    def tick(self) -> Frame:
        self.now += 1.0
        self.session.tick(self.now)
        latest = self.session.latest
        assert isinstance(latest, Frame) and not latest.pace.error
        return latest

    @property
    def frame(self) -> Frame:
        latest = self.session.latest
        assert isinstance(latest, Frame)
        return latest


@pytest.fixture
def table() -> Iterator[Table]:
    table = Table()
    yield table
    table.session.start().close()


def test_steps_that_make_no_sense_here_are_left_out(table: Table):
    titles = [step.title for step in steps(table.frame, CHOICES)]
    assert len(titles) == 8 and "Another policy" in titles
    assert len(list(steps(table.frame, CHOICES[:1]))) == 7
    for step in steps(table.frame, CHOICES):
        assert 60 < len(step.words) < 320


def test_every_step_does_what_it_says(table: Table, server: viser.ViserServer):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    tour.begin()
    seen = [table.tick()]
    for _ in range(7):
        for _ in range(3):
            table.tick()
        tour.next()
        seen.append(table.tick())
    settings = [str(frame.condition) for frame in seen]
    assert settings[0] == settings[2] == settings[7] == "all"
    assert settings[1] == "first+third_b"
    assert settings[3].startswith("all · third_b:black")
    assert settings[4] == settings[5] == settings[6] == "first"
    assert [frame.world.policy.method for frame in seen] == ["mad"] * 5 + ["merged-only"] * 2 + [
        "mad"
    ]
    assert seen[6].past and seen[6].pace.phase == "paused"
    assert not client.notes
    assert not seen[7].past and seen[7].pace.phase == "playing" and seen[7].branch is None


def test_whenever_it_is_left_all_is_as_before(table: Table, server: viser.ViserServer):
    before = CameraState("rgb", Occlusion("blur", 0.5))
    for command in (SetCamera("third_a", before), SetSpeed(20.0)):
        table.session.send(command)
    table.tick()
    for leave_after in range(8):
        tour = Tour(browser(server), table.session.send, lambda: table.frame, CHOICES, [])
        tour.begin()
        for _ in range(leave_after):
            table.tick()
            tour.next()
        tour.end()
        frame = table.tick()
        assert frame.camera("third_a") == before and frame.camera("first").input == "rgb"
        assert frame.world.policy.name == "toy-mad-light" and frame.pace.speed == 20.0
        assert frame.pace.phase == "playing" and not frame.past
        tour.end()  # Twice does no harm.


def test_what_a_visitor_does_meanwhile_does_not_stay_either(
    table: Table, server: viser.ViserServer
):
    table.session.send(Pause())
    table.tick()
    tour = Tour(browser(server), table.session.send, lambda: table.frame, CHOICES, [])
    tour.begin()
    assert table.tick().pace.phase == "playing"
    table.session.send(SetPolicy("toy-merged-only-light"))
    assert table.tick().world.policy.method == "merged-only"
    tour.end()
    frame = table.tick()
    assert (frame.world.policy.method, frame.pace.phase) == ("mad", "paused")


def test_a_tour_clicked_through_fast_brings_the_policy_back(
    table: Table, server: viser.ViserServer
):
    sent: list = []
    still = table.frame  # The page's newest frame does not move meanwhile.
    tour = Tour(browser(server), sent.append, lambda: still, CHOICES, [])
    tour.begin()
    for _ in range(5):
        tour.next()
    tour.end()
    swaps = [one.name for one in sent if isinstance(one, SetPolicy)]
    assert swaps == ["toy-merged-only-light", "toy-mad-light"]


def test_a_policy_comes_back_by_what_it_was_loaded_by(table: Table, server: viser.ViserServer):
    """Its own name is that of another: the shipped one."""
    sent: list = []
    still = with_world(table.frame, reference="runs/toy-mad-light")
    tour = Tour(browser(server), sent.append, lambda: still, CHOICES, [])
    tour.begin()
    for _ in range(5):
        tour.next()
    tour.end()
    assert [one.name for one in sent if isinstance(one, SetPolicy)][-1] == "runs/toy-mad-light"


def buttons(client) -> list[str]:
    """What the buttons of the tour's window say."""
    return [one.label for one in client.gui.present if type(one).__name__ == "GuiButtonHandle"]


def test_the_comparison_is_offered_and_drops_a_camera_on_both_sides(
    table: Table, server: viser.ViserServer
):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    tour.greet()
    assert buttons(client) == ["just show me", "explore one policy"]
    assert table.tick().second is None
    use(client.gui.find("just show me"))
    frame = table.tick()
    assert frame.second is not None and frame.linked and frame.world.step < 2
    assert (frame.world.policy.method, frame.second.world.policy.method) == ("mad", "merged-only")
    while (frame := table.tick()).world.step < GOES_AT:
        assert frame.condition.subset == "all"
    assert frame.second is not None
    assert frame.condition.subset == frame.second.condition.subset == "third_a+third_b"
    tour.next()
    assert table.tick().schedule
    tour.next()
    assert buttons(client) == ["keep comparing", "explore one policy"]
    frame = table.tick()
    assert not frame.schedule and frame.condition.subset == "all" and frame.second is not None
    tour.next()
    assert table.tick().second is not None and "Your turn" not in client.gui.html


def test_a_guess_is_heard_and_leads_on(table: Table, server: viser.ViserServer):
    client = browser(server)
    guesses: list[str] = []
    tour = Tour(
        client, table.session.send, lambda: table.frame, CHOICES, [], guessed=guesses.append
    )
    tour.greet()
    assert client.gui.find("Your guess").options == ("MAD", "Merged Only", "both", "neither")
    use(client.gui.find("Your guess"), "both")
    assert guesses == ["both"] and table.tick().second is not None
    labels = [getattr(handle, "label", "") for handle in client.gui.present]
    assert "Your guess" not in labels
    tour.end()
    tour.greet()
    use(client.gui.find("just show me"))
    assert guesses == ["both", "just show me"]
    tour.end()


def test_where_guards_are_fitted_the_comparison_has_three_acts(
    table: Table, server: viser.ViserServer, monkeypatch
):
    monkeypatch.setattr("madviz.app.tour.has_guard", lambda policy: True)
    sent: list = []
    still = table.frame
    client = browser(server)
    tour = Tour(client, sent.append, lambda: still, CHOICES, [])
    tour.greet()
    assert buttons(client)[0] == "show me" and not sent
    use(client.gui.find("show me"))
    assert Compare("toy-merged-only-light") in sent and SetSchedule(()) in sent
    sent.clear()
    use(client.gui.find("Your guess"), "MAD")
    black = SetSchedule((Event(GOES_AT, "first", occlusion=Occlusion("black")),))
    assert sent == [black, SetSeed(FIRST_DEVELOPMENT), Play()]
    sent.clear()
    tour.next()
    assert sent[:4] == [
        Compare("guard:toy-merged-only-light"),
        Link(True),
        SetPolicy("guard:toy-mad-light"),
        black,
    ]
    sent.clear()
    tour.next()
    assert sent[:2] == [SetSchedule(()), SetPolicy("toy-mad-light")]
    assert Compare("toy-merged-only-light") in sent
    assert all(60 < len(step.words) < 320 for step in acts(still, "toy-merged-only-light"))
    tour.end()


def test_one_click_leads_past_the_comparison_and_leaves_all_as_it_is(
    table: Table, server: viser.ViserServer
):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    tour.greet()
    table.session.send(SetCamera("first", CameraState("off")))
    use(client.gui.find("explore one policy"))
    frame = table.tick()
    assert frame.second is None and frame.camera("first").input == "off"
    assert buttons(client) == []


def test_where_there_is_nothing_to_compare_with_it_says_which_policy_has_something(
    table: Table, server: viser.ViserServer
):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    table.session.send(SetPolicy("toy-merged-only-light"))
    table.tick()
    use(client.gui.find("New?"), "compare")
    (title, words), *others = client.notes
    assert title == "Choose another policy first" and not others
    assert "Here, toy-mad-light has one." in words and buttons(client) == []
    table.session.send(SetPolicy("toy-mad-light"))
    table.tick()
    use(client.gui.find("New?"), "compare")
    assert table.tick().second is not None
    tour.remove()
    client = browser(server)
    begun = Tour(client, table.session.send, lambda: table.frame, CHOICES[:1], [])
    assert client.gui.find("New?").options[0] != "compare"
    begun.remove()


def test_another_task_does_not_keep_the_tours_failures(table: Table, server: viser.ViserServer):
    shown = [table.frame]
    sent: list[object] = []
    tour = Tour(browser(server), sent.append, lambda: shown[0], CHOICES, [])
    tour.begin()
    tour.next()
    sent.clear()
    other = replace(table.frame.world.env, task="metaworld/push")
    shown[0] = with_world(table.frame, env=other, reference="metaworld-push-mad-light")
    tour.remove()
    before = table.frame
    assert sent == [SetSchedule(before.schedule), SetSpeed(before.pace.speed)]


def test_a_button_does_what_it_says_whatever_is_open(table: Table, server: viser.ViserServer):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    tour.greet()
    use(client.gui.find("New?"), "compare")
    assert table.tick().second is not None, "it was offered already"
    assert buttons(client) == ["next step", "explore one policy"]
    use(client.gui.find("New?"), "compare")
    assert buttons(client) == ["next step", "explore one policy"] and table.tick().linked
    use(client.gui.find("New?"), "tour")
    assert buttons(client) == ["next step", "end the tour"] and "What you see" in client.gui.html
    assert table.tick().second is None
    use(client.gui.find("New?"), "tour")
    assert buttons(client) == ["next step", "end the tour"]
    use(client.gui.find("New?"), "compare")
    assert table.tick().second is not None, "who asks for it need not ask twice"
    assert buttons(client) == ["next step", "explore one policy"]


def at_another_policy(table: Table, server: viser.ViserServer) -> tuple[Any, Tour]:
    """A browser whose tour has gone on to the policy that learned with all cameras only."""
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES, [])
    tour.begin()
    while "Another policy" not in client.gui.html:
        tour.next()
        table.tick()
    assert table.frame.world.policy.name == "toy-merged-only-light"
    return client, tour


def test_the_comparison_begins_where_the_tour_shows_another_policy(
    table: Table, server: viser.ViserServer
):
    client, _ = at_another_policy(table, server)
    use(client.gui.find("New?"), "compare")
    frame = table.tick()
    assert frame.world.policy.name == "toy-mad-light" and frame.second is not None
    assert frame.condition == Condition("all")
    use(client.gui.find("explore one policy"))
    frame = table.tick()
    assert frame.world.policy.name == "toy-mad-light" and frame.condition == Condition("all")


def test_the_comparison_begins_while_the_tour_is_taken_back(
    table: Table, server: viser.ViserServer
):
    client, tour = at_another_policy(table, server)
    tour.end()
    use(client.gui.find("New?"), "compare")
    frame = table.tick()
    assert frame.world.policy.name == "toy-mad-light" and frame.second is not None


def test_what_a_visitor_changes_after_a_tour_is_not_taken_back_by_the_next(
    table: Table, server: viser.ViserServer
):
    client = browser(server)
    guesses: list[str] = []
    tour = Tour(
        client, table.session.send, lambda: table.frame, CHOICES, [], guessed=guesses.append
    )
    tour.begin()
    tour.next()
    tour.end()
    table.session.send(SetCamera("third_a", CameraState("off")))
    before = table.tick()
    use(client.gui.find("New?"), "compare")
    assert table.tick().second is not None and guesses == [], "nobody was asked for a guess"
    use(client.gui.find("explore one policy"))
    assert table.tick().condition == before.condition


def test_whenever_the_comparison_is_left_all_is_as_before(table: Table, server: viser.ViserServer):
    beside = Compare("toy-merged-only-light", Ablation({"first": CameraState("off")}))
    moved = MoveCamera("third_b", Displacement(pan=10))
    for command in (SetCamera("third_a", CameraState("off")), moved, beside):
        table.session.send(command)
    before = table.tick()
    assert before.second is not None and not before.linked
    for leave_after in range(1, 4):
        tour = Tour(browser(server), table.session.send, lambda: table.frame, CHOICES, [])
        tour.greet()
        for _ in range(leave_after):
            tour.next()
            during = table.tick()
        table.session.send(MoveCamera("first", Displacement(pan=5)))
        assert not during.world.ablation.moves
        tour.end()
        frame = table.tick()
        assert not frame.schedule and frame.world.ablation.moves == before.world.ablation.moves
        assert frame.second is not None and not frame.linked
        assert frame.second.condition == before.second.condition
        assert frame.condition == before.condition and frame.pace.speed == before.pace.speed


def test_there_is_no_comparison_without_a_policy_to_compare_with(
    table: Table, server: viser.ViserServer
):
    client = browser(server)
    tour = Tour(client, table.session.send, lambda: table.frame, CHOICES[:1], [])
    tour.greet()
    assert buttons(client) == [] and "compare" not in client.gui.find("New?").options
    for step in comparison_steps(table.frame, "toy-merged-only-light"):
        assert 60 < len(step.words) < 320


def test_a_watcher_is_offered_help_and_no_tour(table: Table, server: viser.ViserServer):
    offered = []
    for send in (None, table.session.send):
        client = browser(server)
        Tour(client, send, lambda: table.frame, CHOICES, [])
        offered.append(client.gui.find("New?").options)
    assert offered == [("help, keys",), ("compare", "tour", "help, keys")]
    table.session.send(StepOnce())
    client = browser(server)
    Tour(client, None, lambda: table.frame, CHOICES, []).begin()
    assert not client.gui.of("PanelHandle")


def test_help_has_the_words_and_the_keys():
    for word in ("off", "black", "merged", "Q", "action"):
        assert f"**{word}**" in HELP
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        client = browser(server)
        keys = [("Play or pause", "space", print), ("Drop First person", "1", print)]
        Tour(client, None, lambda: None, [], keys).help()
        words, table = (one.content for one in client.gui.of("GuiMarkdownHandle"))
        assert words == HELP
        assert "| **space** | Play or pause |" in table and table.count("\n") == 3
    finally:
        server.stop()


def test_help_that_is_asked_for_again_takes_the_place_of_the_first() -> None:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        tour = Tour(browser(server), None, lambda: None, [], [("help", "?", print)])
        for _ in range(5):
            tour.help()
        assert len(server.gui._modal_handle_from_uuid) == 1
        tour.remove()
    finally:
        server.stop()
