"""A policy of one's own that is called like a shipped one: the page takes neither for the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from madviz.app.panel import apply
from madviz.app.panels.move import move_html
from madviz.app.panels.policy import PolicyChoice, PolicyPanel
from madviz.app.server import shipped_rates
from madviz.app.tour_steps import comparison_steps, restored, steps, whole
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.policies.checkpoint import describe
from madviz.session.commands import Command, Compare, Play, Reset, Scrub, SetPolicy
from madviz.session.comparison import tally
from madviz.session.frame import Frame, Outcome, Pair
from tests.checkpoints import measure, saved
from tests.fakes import FakePolicy
from tests.pages import recorded
from tests.sessions import Recorder, frame_with

OWN, SHIPPED = FakePolicy("toy-mad", seed=3), FakePolicy("toy-mad")
"""A training of one's own, and the shipped policy of the same name."""


def acts_by_its_folder(*commands: Command) -> Frame:
    """The frame after ``commands``, where the policy of one's own was loaded by its folder."""
    session = Recorder(SHIPPED, load=lambda name: OWN)
    session.at(0.0)
    return session.ask(SetPolicy("runs/mine"), *commands)


def test_shipped_rates_are_those_of_the_folder_and_its_weights(tmp_path: Path) -> None:
    folder = saved(tmp_path)
    row = {"success": 0.5, "success_any": 0.5, "n": 2, "ci95": [0.1, 0.9], "trained": True}
    spec = describe(folder).spec
    assert shipped_rates(str(folder), spec) == {}, "it was not measured yet"
    measure(folder, {"all": row})
    assert shipped_rates(str(folder), spec)["all"]["success"] == 0.5
    assert shipped_rates(str(folder), replace(spec, digest="other weights")) == {}
    for elsewhere in (spec.name, "tests.test_wire:make", "ws://127.0.0.1:9"):
        assert shipped_rates(elsewhere, spec) == {}, "the name says nothing of the weights"


def test_a_policy_of_ones_own_is_not_taken_for_the_shipped_one_of_its_name(server):
    sent: list = []
    choices = [PolicyChoice("runs/mine", "runs/mine"), PolicyChoice("toy-mad", "MAD")]
    gui = recorded(server.gui)
    frame = acts_by_its_folder()
    panel = PolicyPanel(gui, sent.append, frame, choices)
    assert gui.find("Policy").value == "runs/mine"
    apply(panel.update(frame_with(policy=SHIPPED)))
    assert gui.find("Policy").value == "MAD"
    apply(panel.update(frame))
    assert gui.find("Policy").value == "runs/mine"
    panel.remove()
    for commands in (whole(frame), restored(frame)):
        assert SetPolicy("runs/mine") in commands
    for step in (*steps(frame, choices), *comparison_steps(frame, "b")):
        assert SetPolicy("toy-mad") not in step.commands
    assert "audit --policy runs/mine --along first.pan=0:5 " in move_html(
        acts_by_its_folder(MoveCamera("first", Displacement(pan=5)))
    )


def test_a_step_that_is_looked_back_at_has_the_policy_of_then():
    session = Recorder(SHIPPED, load=lambda name: OWN)
    session.steps(2)
    assert session.ask(SetPolicy("runs/mine")).world.reference == "runs/mine"
    session.steps(2)
    back = session.ask(Scrub(1)).world
    assert (back.policy, back.reference) == (SHIPPED.spec, "toy-mad")
    again = session.ask(Play(), SetPolicy("runs/copy"), Compare("runs/copy"))
    assert again.second is not None
    assert again.world.reference == again.second.world.reference == "runs/mine", "the first name"


def test_an_episode_of_two_policies_of_one_name_has_no_condition():
    session = Recorder(SHIPPED, load=lambda name: OWN)
    session.steps(2)
    session.ask(SetPolicy("runs/mine"))
    outcomes = session.steps(30).world.outcomes
    assert [one.policy for one in outcomes] == [OWN.spec] and outcomes[0].condition is None
    session.ask(Reset())
    assert session.steps(30).world.outcomes[-1].condition == Condition("all")


def test_pairs_with_another_policy_of_that_name_do_not_count():
    outcome = Outcome(OWN.spec, 0, True, {}, Condition("all"))
    own = Pair(outcome, outcome)
    other = replace(outcome, seed=1)
    shipped = Pair(replace(other, policy=SHIPPED.spec), other)
    assert tally((own, shipped), shipped.sides).n == 1
