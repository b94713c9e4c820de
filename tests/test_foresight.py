"""What a policy imagines of the decisions to come, and how it is held against what happens."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import viser

from madviz.agent.agent import Agent
from madviz.analysis.foresight import DECISIONS, Foresight, can_foresee, foresee, mean_psnr, then
from madviz.app.panel import apply
from madviz.app.panels.foresight import ForesightPanel, foresight_html, foresight_words
from madviz.errors import UserError
from madviz.session.commands import Command, Foresee, Reset, Scrub, SetCamera, SetPolicy
from madviz.session.frame import Frame
from madviz.session.transfer import FrameDecoder, FrameEncoder
from madviz.types import Array, Encoded, Foresees, Future
from madviz.world_model.actor_critic import likeliest
from tests.fakes import FakePolicy
from tests.mv_mwm import GROUPS, advanced, believed, drawn, make, mlp, net_of, policy_of
from tests.pages import recorded, use
from tests.sessions import OFF, Recorder, frame_with
from tests.test_merges import pictures, weights


class Seer(FakePolicy):
    """Imagines grey pictures that get brighter, and rewards that grow."""

    foresees = True
    imagines = True

    def imagine(self, encoded: Encoded, mask: Array) -> Array:
        return self.mean_pictures()

    def mean_pictures(self) -> Array:
        return np.zeros((3, 84, 84, 3), np.uint8)

    def foresee(self, encoded: Encoded, mask: Array, decisions: int) -> Future:
        count = np.arange(decisions)
        grey = np.broadcast_to(count.astype(np.uint8)[:, None, None, None, None], SHAPE).copy()
        return Future(grey, count.astype(np.float32), np.zeros((decisions, 2), np.float32))


SHAPE = (DECISIONS, 3, 84, 84, 3)


@pytest.fixture
def session() -> Recorder:
    session = Recorder(Seer())
    session.at(0.0)
    return session


def foresight_of(frame: Frame) -> Foresight:
    assert frame.foresight is not None
    return frame.foresight


# --- The world model ----------------------------------------------------------------------------


def test_the_likeliest_course_is_the_formula() -> None:
    agent = make().double()
    start, state = believed(agent), torch.from_numpy(np.random.default_rng(1).normal(size=(3, 6)))
    beliefs, actions = likeliest(net_of(agent).world, agent.actor, start, state, 3)
    w, actor = weights(agent.encoder), weights(agent.actor)
    memory, latent = start.deterministic[1].numpy(), start.latent[1].flatten().numpy()
    known = state[1].numpy()
    for step in range(3):
        middle, _ = np.split(mlp(actor, "mlp", np.concatenate([memory, latent, known])), 2)
        action = np.tanh(middle)
        np.testing.assert_allclose(actions[step, 1].detach().numpy(), action, rtol=1e-4)
        memory = advanced(w, memory, latent, action)
        latent = drawn(mlp(w, "world.rssm.prior", memory), None)
        belief = np.concatenate([memory, latent])
        np.testing.assert_allclose(beliefs[step, 1].detach().numpy(), belief, rtol=1e-4)
        told = mlp(w, "world.state", belief)
        known = np.sign(told) * np.expm1(np.abs(told))
    assert latent.sum() == GROUPS


def test_a_policy_begins_at_its_belief_and_draws_what_it_predicts() -> None:
    agent = make().eval()
    policy, views, state = policy_of(agent), pictures()[0].numpy(), np.full(6, 0.3, np.float32)
    encoded, mask = policy.encode(views, state), np.array([True, False, True])
    found = policy.foresee(encoded, mask, 4)
    assert found.pictures.shape == (4, 3, 84, 84, 3) and found.pictures.dtype == np.uint8
    assert found.reward.shape == (4,) and found.action.shape == (4, 2)
    first = policy.read(encoded, mask[None]).action[0]
    np.testing.assert_allclose(found.action[0], first, rtol=1e-5)
    other = views.copy()
    other[1] = 255 - other[1]
    again = policy.foresee(policy.encode(other, state), mask, 4)
    np.testing.assert_array_equal(again.pictures, found.pictures)  # Nothing of an absent camera.
    sooner = policy.foresee(encoded, mask, 2)
    np.testing.assert_allclose(sooner.reward, found.reward[:2], rtol=1e-5)
    with torch.inference_mode():
        net, features = net_of(agent), encoded.private[0]
        belief = net.belief(net.present(features, torch.from_numpy(mask))[None])
        beliefs, _ = likeliest(net.world, agent.actor, belief, torch.from_numpy(state)[None], 4)
        tokens = net.world.predicted_features(beliefs[3])
        picture = net.autoencoder.draw(tokens, torch.arange(108)[None]).pictures[0]
        reward = net.world.predicted_reward(beliefs[3]).item()
    expected = (255 * picture.clamp(0, 1)).round().byte().permute(0, 2, 3, 1).numpy()
    assert np.abs(found.pictures[3].astype(int) - expected).max() <= 1
    assert found.reward[3] == pytest.approx(reward, rel=1e-4)


def test_who_has_no_world_model_says_so() -> None:
    policy = FakePolicy()
    assert isinstance(Seer(), Foresees) and can_foresee(Seer()) and not can_foresee(policy)
    encoded = policy.encode(pictures()[0].numpy(), np.zeros(6, np.float32))
    with pytest.raises(UserError, match="expected a policy with a world model, found toy-mad"):
        foresee(policy, encoded, np.ones(3, bool), 0, "all")
    sums = policy_of(Agent(make().config))
    with pytest.raises(UserError, match="whose merge 'sum' has none"):
        sums.foresee(encoded, np.ones(3, bool), 2)
    trained = policy_of(make())
    encoded = trained.encode(pictures()[0].numpy(), np.zeros(6, np.float32))
    with pytest.raises(UserError, match="expects any subset"):
        trained.foresee(encoded, np.zeros(3, bool), 2)
    with pytest.raises(UserError, match="cannot act on 'none'"):
        foresee(trained, encoded, np.zeros(3, bool), 0, "none")


# --- What happens -------------------------------------------------------------------------------


def test_each_decision_is_held_against_what_was_imagined(session: Recorder) -> None:
    at = session.steps(2).world.step
    began = foresight_of(session.ask(Foresee()))
    assert (began.step, began.condition, began.happened) == (at, "all", ())
    frame = session.steps(1)
    while frame.world.step < at + 3:
        frame = session.steps(1)
    now = foresight_of(frame)
    assert len(now.happened) == frame.world.step - at and not now.disturbed and not now.closed
    last = now.happened[-1]
    assert last.reward == frame.world.reward
    np.testing.assert_array_equal(last.pictures[1], frame.world.views["third_a"].rgb)
    moves = (last.pictures[1] > 10).any(-1)
    error = np.square((last.pictures[1][moves] - float(len(now.happened) - 1)) / 255).mean()
    assert last.psnr[1] == pytest.approx(-10 * np.log10(error), rel=1e-5)
    assert mean_psnr(now) == pytest.approx(np.mean([one.psnr for one in now.happened]))
    assert now.future is began.future


def test_it_ends_after_all_decisions_or_with_the_episode_and_stays(session: Recorder) -> None:
    session.ask(Foresee())
    frame = session.frames[-1]
    while frame.world.step < DECISIONS + 3:
        frame = session.steps(1)
    whole = foresight_of(frame)
    assert whole.closed and len(whole.happened) == DECISIONS
    session.ask(Foresee())
    while frame.world.episode == 1:
        frame = session.steps(1)
    frame = session.steps(2)
    short = foresight_of(frame)
    assert short.closed and len(short.happened) < DECISIONS
    assert "then the episode was over" in foresight_words(short)
    assert "over" not in foresight_words(whole)
    assert session.ask(Foresee(on=False)).foresight is None


def test_other_cameras_meanwhile_are_noted(session: Recorder) -> None:
    session.ask(Foresee())
    assert not foresight_of(session.steps(1)).disturbed
    session.ask(SetCamera("third_a", OFF))
    told = foresight_of(session.steps(2))
    assert told.disturbed and "no test of it" in foresight_words(told)
    again = foresight_of(session.ask(Foresee()))
    assert again.condition == "first+third_b" and not again.disturbed


def test_another_policy_and_another_past_forget_it(session: Recorder) -> None:
    session.steps(3)
    session.ask(Foresee())
    shown = session.ask(Scrub(1))
    assert shown.past and foresight_of(shown).step > 1, "it says itself of which step it is"
    session.ask(SetCamera("first", OFF))  # Forks.
    assert session.frames[-1].foresight is None
    session.ask(Foresee())
    assert session.ask(SetPolicy("toy-mad")).foresight is None
    session.ask(Foresee())
    assert "expected a policy with a world model" in session.frames[-1].pace.error
    assert not session.frames[-1].world.foresees


def test_asked_from_the_past_it_begins_at_the_newest_step(session: Recorder) -> None:
    newest = session.steps(3).world.step
    assert session.ask(Scrub(0)).past
    frame = session.ask(Foresee())
    assert not frame.past and foresight_of(frame).step == newest


def test_between_processes_what_was_imagined_is_sent_once(session: Recorder) -> None:
    encoder, decoder = FrameEncoder(), FrameDecoder()
    first = encoder.encode(session.ask(Foresee()))
    before = decoder.decode(first)
    second = encoder.encode(session.steps(1))
    after = decoder.decode(second)
    assert isinstance(before, Frame) and isinstance(after, Frame)
    assert foresight_of(after).future is foresight_of(before).future
    assert len(first) - len(second) > 0.8 * np.prod(SHAPE)


def test_what_nobody_knows_is_not_averaged() -> None:
    frame = frame_with(Foresee(), policy=Seer())
    told = foresight_of(frame)
    assert np.isnan(mean_psnr(told))
    policy, world = Seer(), frame.world
    later = then(told, policy, world.views, world.env, 0.5, "all")
    assert later.happened[0].reward == 0.5 and not told.happened


# --- The page -----------------------------------------------------------------------------------


def test_only_who_foresees_has_the_button(server: viser.ViserServer) -> None:
    sent: list[Command] = []
    gui = recorded(server.gui)
    panel = ForesightPanel(gui, sent.append, frame_with())
    button = gui.find("imagine 15 decisions")
    assert not button.visible
    apply(panel.update(frame_with(policy=Seer())))
    assert button.visible
    use(button)
    assert sent == [Foresee()]
    apply(panel.update(frame_with()))
    assert not button.visible
    panel.remove()
    watching = ForesightPanel(recorded(server.gui), None, frame_with())
    assert len(watching.handles) == 1, "who watches has no button"
    watching.remove()


def test_the_panel_is_drawn_when_something_has_happened(session: Recorder) -> None:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    panel = ForesightPanel(server.gui, None, session.frames[-1])
    assert panel._text.content == ""
    frame = session.ask(Foresee())
    apply(panel.update(frame))
    drawing = panel._text.content
    assert drawing == foresight_html(foresight_of(frame), frame)
    assert "from <b>all</b>" in drawing and "0 have been taken" in drawing
    assert drawing.count("<img") == 6 and drawing.count("polyline") == 2
    apply(panel.update(session.steps(1)))
    assert panel._text.content != drawing and "dB where something moves" in (panel._text.content)
    apply(panel.update(session.ask(Reset(next_seed=True), Foresee(on=False))))
    assert panel._text.content == ""
    server.stop()
