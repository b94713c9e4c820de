"""Policies that act from earlier steps, too: chunks, a history, noise; and those that read one set
of cameras at a time."""

from __future__ import annotations

import numpy as np

from madviz.analysis.probes import probe, read_row
from madviz.app.panels.policy import status_html
from madviz.app.panels.subsets import subsets_html
from madviz.envs.registry import make_env
from madviz.measure.evaluate import evaluate
from madviz.policies.players import player_of
from madviz.session.commands import Fork, Pause, Play, ReadSubsets, Scrub, SetCamera
from tests.fakes import Chunked, FakePolicy, Restless
from tests.sessions import OFF, Recorder, frame_with


def test_an_evaluation_looks_once_for_every_chunk_and_ends_what_it_began():
    policy = Chunked()
    evaluate(policy, ["all"], episodes=2)
    assert policy.looks == 2 * 7, "25 decisions of the toy are 7 looks"
    assert len(policy.players) == 2 and all(player.closed for player in policy.players)


def test_who_needs_no_memory_acts_by_what_it_reads():
    policy, mask = FakePolicy(), np.array([True, False, True])
    views = np.random.default_rng(0).integers(0, 255, (3, 9, 84, 84), np.uint8)
    encoded = policy.encode(views, np.zeros(6, np.float32))
    player = player_of(policy, 3)
    np.testing.assert_array_equal(
        player.act(encoded, mask), policy.read(encoded, mask[None]).action[0]
    )


def test_an_earlier_step_has_the_memory_it_had():
    straight = Recorder(Chunked(), seed=2007)
    straight.steps(9)
    session = Recorder(Chunked(), seed=2007)
    session.steps(9)
    session.ask(Scrub(6), Fork())
    session.steps(3)
    there, again = straight.frames[-1].world, session.frames[-1].world
    assert there.step == again.step == 9
    np.testing.assert_array_equal(there.hand, again.hand)


def test_what_is_settled_is_shown_and_a_camera_counts_at_the_next_look():
    session = Recorder(Chunked())
    assert session.at(0.0) is not None and session.frames[-1].world.planned == 0
    frame = session.steps(2)
    assert frame.world.planned == 2
    assert "looks again after 2 more decisions" in status_html(frame)
    untouched = Recorder(Chunked())
    untouched.at(0.0)
    untouched.steps(2)
    session.ask(SetCamera("first", OFF))
    for step, alike in ((3, True), (4, True), (5, False)):
        one, other = (each.steps(1).world.hand for each in (session, untouched))
        assert np.array_equal(one, other) == alike, step


def test_noise_that_no_seed_fixes_cannot_be_gone_back_to():
    session = Recorder(Restless())
    session.steps(8)
    session.ask(Scrub(5), Fork())
    assert "its noise is not fixed by a seed" in session.frames[-1].pace.error


def test_two_visitors_of_one_policy_do_not_share_its_memory():
    policy = Chunked()
    alone, first, second = (Recorder(p, seed=2003) for p in (Chunked(), policy, policy))
    for session in (alone, first, second):
        session.at(0.0)
    for _ in range(6):
        for session in (alone, first, second):
            session.steps(1)
    hands = [session.frames[-1].world.hand for session in (alone, first, second)]
    np.testing.assert_array_equal(hands[0], hands[1])
    np.testing.assert_array_equal(hands[0], hands[2])


# --- One set of cameras at a time ---


def test_only_the_set_that_is_seen_is_read_until_somebody_asks_for_more():
    policy = Chunked()
    session = Recorder(policy)
    session.at(0.0)
    assert policy.read_rows == 1 and session.frames[-1].world.probe.known.sum() == 1
    session.ask(Pause(), SetCamera("first", OFF))
    assert policy.read_rows == 2
    frame = session.frames[-1]
    assert frame.world.probe.known[frame.row] and np.isfinite(frame.action).all()
    assert "not read" in subsets_html(frame)
    session.send(ReadSubsets(True))
    while session.tick(0.0) is not None:
        pass
    frame = session.frames[-1]
    assert frame.world.probe.known.all() and policy.read_rows == 8
    assert "not read" not in subsets_html(frame)
    session.ask(Play())
    assert session.frames[-1].world.probe.known.sum() >= 1


def test_reading_row_by_row_gives_what_reading_together_gives():
    policy = FakePolicy()
    views = np.random.default_rng(0).integers(0, 255, (3, 9, 84, 84), np.uint8)
    encoded = policy.encode(views, np.zeros(6, np.float32))
    together, one = probe(policy, encoded), probe(policy, encoded, only=3)
    assert one.known.sum() == 1 and np.isnan(one.readout.action[2]).all()
    for row in range(8):
        one = read_row(one, policy, encoded, row)
    np.testing.assert_allclose(one.readout.action, together.readout.action, atol=1e-6)
    assert one.known.all() and one.merged_kind() == "sum"


def test_a_policy_of_other_sizes_gets_them():
    policy = FakePolicy()
    sizes: list[tuple[int, ...]] = []
    encode = policy.encode

    def seen(views, state):
        sizes.append(views.shape)
        return encode(views[..., :84, :84], state)

    from dataclasses import replace

    policy.encode, policy.spec = seen, replace(policy.spec, image_size=128, frame_stack=1)
    evaluate(policy, ["all"], episodes=1)
    assert set(sizes) == {(3, 3, 128, 128)}
    assert make_env("toy/reach").spec.instruction
    assert frame_with(policy=policy).world.arrived["first"].shape == (128, 128, 3)
