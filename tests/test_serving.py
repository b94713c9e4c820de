"""madviz serve: the same policy here and there, to the bit, and who may ask it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from queue import Queue

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.examples.own_policy import Finder
from madviz.measure.evaluate import evaluate
from madviz.observation.ablation import Occlusion
from madviz.policies.checkpoint import load_policy
from madviz.policies.players import Reader
from madviz.serving import serve
from madviz.serving.episodes import BadLook, ServedEpisodes
from madviz.serving.serve import MOST_CLIENTS, PolicyServer, ServeConfig, run_serve
from madviz.session.commands import Fork, Scrub, SetCamera
from madviz.types import Encoded, Policy, TakesPictures
from madviz.wire.codec import pack, unpack
from madviz.wire.policy import ServedPolicy
from tests.fakes import AllOrNothing, Chunked, FakePolicy, random_policy
from tests.pages import until
from tests.sessions import BLACK, OFF, Recorder
from tests.wires import wiring_file


@contextmanager
def serving(policy: Policy, token: str | None = None) -> Iterator[PolicyServer]:
    server = PolicyServer(policy, token=token).start()
    try:
        yield server
    finally:
        server.close()


def networks() -> Policy:
    """MAD's networks, small and untrained, for the toy."""
    config = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=32, feature_dim=16)
    return random_policy(FakePolicy().spec, config)


POLICIES = {
    "pixels": Finder,
    "networks": networks,
    "all or nothing": AllOrNothing,
    "chunks": Chunked,
}


def test_a_wire_file_keeps_the_subsets_of_a_policy_of_ours(tmp_path):
    with serving(FakePolicy()) as server:
        known = load_policy(server.address).spec
        assert known.trained_subsets == ("all", "first", "third_a", "third_b")
        turned = '{ third_b = "third_a", third_a = "third_b", first = "first" }'
        file = wiring_file(tmp_path, cameras=turned)
        swapped = load_policy(f"{server.address}#wire={file}")
        assert swapped.spec.trained_subsets == ("all", "first", "third_b", "third_a")
        file = wiring_file(tmp_path, cameras='{ first = "first", third_a = "third_a" }')
        fewer = load_policy(f"{server.address}#wire={file}")
        assert fewer.spec.trained_subsets == ("first", "third_a"), "it was not trained on the two"
    with serving(AllOrNothing()) as server:
        file = wiring_file(tmp_path, cameras='{ first = "first", third_a = "third_a" }')
        with pytest.raises(UserError, match="its own first, third_a, third_b, and needs"):
            load_policy(f"{server.address}#wire={file}")
        every = '{ first = ["first"], third_a = "third_a", third_b = "third_b" }'
        policy = load_policy(f"{server.address}#wire={wiring_file(tmp_path, cameras=every)}")
        assert policy.supports(np.ones(3, bool)) and not policy.supports(np.array([1, 1, 0], bool))
        assert isinstance(policy, ServedPolicy) and not policy.stateless, "the file may not know"


@pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)
def test_served_and_here_give_the_same_episodes_to_the_bit(make):
    here, black = make(), {"third_a": Occlusion("black")}
    with serving(make()) as server:
        there = load_policy(server.address)
        for occlusions in ({}, black):
            one = evaluate(here, episodes=2, occlusions=occlusions)
            other = evaluate(there, episodes=2, occlusions=occlusions)
            assert one.episodes == other.episodes and one.rows == other.rows
    same = ("name", "task", "streams", "trained_subsets", "digest", "frame_stack", "chunk")
    assert all(getattr(here.spec, name) == getattr(there.spec, name) for name in same)


@pytest.mark.parametrize("make", [Finder, Chunked])
def test_the_page_shows_the_same_episode_of_a_served_policy(make):
    with serving(make()) as server:
        sessions = [Recorder(make(), seed=2004), Recorder(load_policy(server.address), seed=2004)]
        for session in sessions:
            session.at(0.0)
            session.steps(3)
            session.ask(SetCamera("first", OFF))
            session.steps(4)
            session.ask(SetCamera("first", BLACK))
            session.steps(3)
            session.ask(Scrub(5), Fork())
            session.steps(4)
        worlds = [session.frames[-1].world for session in sessions]
        assert [world.step for world in worlds] == [9, 9]
        np.testing.assert_array_equal(worlds[0].hand, worlds[1].hand)


def test_several_episodes_at_the_same_time_do_not_mix():
    with serving(Chunked()) as server:
        alone = evaluate(Chunked(), ["all"], episodes=3, seed=5000).episodes
        found: dict[int, object] = {}

        def play(seed: int) -> None:
            found[seed] = evaluate(server.address, ["all"], episodes=1, seed=seed, workers=0)

        threads = [threading.Thread(target=play, args=(5000 + i,)) for i in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [found[seed].episodes[0] for seed in sorted(found)] == list(alone)  # type: ignore


# --- What others send ---


def answered(socket, kind: str, payload: object) -> dict:
    socket.send(pack({"type": kind, "payload": payload, "seq": 5, "timestamp": 0.0}, "vla-eval"))
    return unpack(socket.recv(5))


def look(**changed):
    picture = np.zeros((84, 84, 3), np.uint8)
    images = {name: picture for name in ("first", "third_a", "third_b")}
    return {"images": images, "state": np.zeros(6, np.float32), **changed}


def _grey(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0]


def test_single_frames_are_stacked_by_the_server_as_they_are_here():
    policy, env = FakePolicy(), make_env("toy/reach")
    expected = evaluate(policy, ["all"], episodes=1, seed=5000).episodes[0]
    with serving(policy) as server, connect(server.address) as socket:
        greeting = answered(socket, "hello", {})["payload"]
        assert greeting["action_spec"]["actions"]["dims"] == 2
        assert greeting["madviz"]["wiring"]["masks"] is True
        begin = {"type": "episode_start", "payload": {}, "seq": 0, "timestamp": 0.0}
        socket.send(pack(begin, "vla-eval"))
        now, total = env.reset(5000), 0.0
        while not now.last:
            images = {camera.name: env.view(camera.name).rgb for camera in env.spec.cameras}
            answer = answered(socket, "observation", look(images=images, state=now.state))
            assert answer["seq"] == 5
            now = env.step(answer["payload"]["actions"])
            total += now.reward
    assert total == expected.total_reward


@pytest.mark.parametrize(
    ("kind", "payload", "said"),
    [
        ("observation", look(images={"left": 1}), "expected pictures of first, third_a, third_b"),
        ("observation", look(images=3), "expected pictures by camera"),
        (
            "observation",
            look(images={"first": np.zeros((84, 84), np.uint8)}),
            r"expected 'first' as \(H, W, 3 or 9\) uint8, 84 by 84, found \(84, 84\)",
        ),
        (
            "observation",
            look(images={"first": np.zeros((480, 640, 3), np.uint8)}),
            "expected 'first' as 84 by 84 pixels, or another square, found 480 by 640",
        ),
        ("observation", look(state=np.zeros(3)), r"expected 6 finite numbers.*found \(3,\)"),
        ("observation", look(state=[np.nan] * 6), "expected 6 finite numbers"),
        ("observation", look(state="x"), "expected 6 finite numbers"),
        ("dance", {}, "expected hello, episode_start or observation, found 'dance'"),
        ("observation", 3, "expected a message with type and payload"),
        ("episode_start", {"seed": "first"}, "expected a whole number as the seed, found 'first'"),
    ],
)
def test_a_look_that_will_not_do_is_answered_in_words_and_the_next_one_works(kind, payload, said):
    with serving(FakePolicy()) as server, connect(server.address) as socket:
        answer = answered(socket, kind, payload)
        assert answer["type"] == "error"
        pytest.raises(UserError, _raise, answer["payload"]["error"]).match(said)
        assert answered(socket, "observation", look())["type"] == "action"


class OwnShapes(FakePolicy):
    """Has pictures of another shape from each camera, and keeps what arrived."""

    shapes = {"first": (48, 64), "third_a": (40, 40), "third_b": (84, 84)}

    def __init__(self) -> None:
        super().__init__()
        self.spec = replace(self.spec, image_size=84, frame_stack=1)
        self.seen: dict[str, np.ndarray] = {}

    def encode_pictures(self, pictures, state):
        self.seen = pictures
        return Encoded(np.zeros((3, 64), np.float32), np.asarray(state, np.float32))


def test_each_camera_arrives_in_its_own_height_and_width():
    policy = OwnShapes()
    assert isinstance(policy, TakesPictures)
    with serving(policy) as server:
        there = load_policy(server.address)
        assert isinstance(there, ServedPolicy) and there.wiring.letterbox
        assert {s: there.wiring.shape_of(s) for s in there.spec.streams} == policy.shapes
        views = np.full((3, 3, 84, 84), 200, np.uint8)
        there.read(there.encode(views, np.zeros(6)), np.ones((1, 3), bool))
        assert {name: seen.shape[:2] for name, seen in policy.seen.items()} == policy.shapes
        first = policy.seen["first"][..., 0]
        assert (first[:, 8:-8] == 200).all() and not first[:, :8].any() and not first[:, -8:].any()
        with connect(server.address) as socket:
            pictures = {n: np.zeros((*s, 3), np.uint8) for n, s in policy.shapes.items()}
            twice = {**pictures, "first": np.zeros((96, 128, 3), np.uint8)}
            assert answered(socket, "observation", look(images=twice))["type"] == "action"
            assert policy.seen["first"].shape == (48, 64, 3)
            square = {**pictures, "first": np.zeros((64, 64, 3), np.uint8)}
            said = answered(socket, "observation", look(images=square))["payload"]["error"]
    assert "'first' as 48 by 64 pixels, or another size of that aspect, found 64 by 64" in said


def _raise(said: str) -> None:
    raise UserError(said)


def test_openpi_is_greeted_answered_and_told_what_was_wrong():
    with serving(FakePolicy()) as server, connect(server.address) as socket:
        assert unpack(socket.recv(5))["madviz"]["wiring"]["task"] == "toy/reach"
        flat = {**look()["images"], "state": np.zeros(6, np.float32), "prompt": "go", "episode": 1}
        socket.send(pack(flat, "openpi"))
        assert unpack(socket.recv(5))["actions"].shape == (1, 2)
        socket.send(pack({**flat, "state": np.zeros(2)}, "openpi"))
        assert "expected 6 finite numbers" in str(socket.recv(5))
        with pytest.raises(ConnectionClosed):
            socket.recv(5)


def openpi_actions(socket, looks, **more) -> list:
    """The answers to looks of random pictures, the same for the same number."""
    found = []
    for number in looks:
        rng = np.random.default_rng(number)
        images = {name: rng.integers(0, 255, (84, 84, 3), np.uint8) for name in look()["images"]}
        state = np.full(6, number / 10, np.float32)
        socket.send(pack({**images, "state": state, **more}, "openpi"))
        found.append(unpack(socket.recv(5))["actions"])
    return found


@pytest.mark.parametrize("make", [networks, Chunked])
def test_the_second_episode_of_a_connection_has_nothing_of_the_first(make):
    with serving(make()) as server, connect(server.address) as socket:
        socket.recv(5)
        first = openpi_actions(socket, range(7), episode=5)
        second = openpi_actions(socket, range(7), episode="next")
        np.testing.assert_array_equal(first, second)
        going_on = openpi_actions(socket, range(7), episode="next")
        assert not np.array_equal(going_on, second), "what an episode leaves behind counts"


def test_an_episode_of_vla_eval_that_ended_leaves_nothing_behind():
    def acted(socket) -> list:
        picture = np.random.default_rng(0).integers(0, 255, (84, 84, 3), np.uint8)
        images = dict.fromkeys(look()["images"], picture)
        seen = [look(), look(images=images)]
        return [answered(socket, "observation", one)["payload"]["actions"] for one in seen]

    with serving(networks()) as server, connect(server.address) as socket:
        first = acted(socket)
        end = {"type": "episode_end", "payload": {}, "seq": 0, "timestamp": 0.0}
        socket.send(pack(end, "vla-eval"))
        np.testing.assert_array_equal(acted(socket), first)
        assert not np.array_equal(acted(socket), first)


@pytest.mark.parametrize(
    ("make", "changed", "said"),
    [
        (networks, {}, r"'episode' beside single frames.* the last 3; .*\(H, W, 9\)"),
        (Chunked, {}, "expected 'episode' in the look, found none, and .* remembers an episode"),
        (networks, {"episode": [1]}, "'episode' as a whole number or a text"),
    ],
)
def test_a_look_of_openpi_that_may_be_of_any_episode_is_refused(make, changed, said):
    with serving(make()) as server, connect(server.address) as socket:
        socket.recv(5)
        sent = {**look()["images"], "state": np.zeros(6, np.float32), **changed}
        socket.send(pack(sent, "openpi"))
        pytest.raises(UserError, _raise, str(socket.recv(5))).match(said)


@pytest.mark.parametrize("as_sent", [np.asarray, np.ndarray.tolist, np.ndarray.tobytes, _grey])
def test_a_picture_under_a_name_that_no_camera_has_is_refused(as_sent):
    with serving(FakePolicy()) as server, connect(server.address) as socket:
        socket.recv(5)
        pictures = {"fisrt": as_sent(np.zeros((84, 84, 3), np.uint8)), **look()["images"]}
        del pictures["first"]
        socket.send(pack({**pictures, "state": np.zeros(6, np.float32), "episode": 1}, "openpi"))
        assert "expected pictures of first, third_a, third_b, found 'fisrt'" in str(socket.recv(5))


@pytest.mark.parametrize(
    "more", [b"x" * 16, [[[1.0] * 4] * 4] * 3, np.zeros((2, 5), np.uint8), b"x" * 4000]
)
def test_what_comes_beside_whole_looks_is_no_picture(more):
    with serving(FakePolicy()) as server, connect(server.address) as socket:
        socket.recv(5)
        whole = {**look()["images"], "state": np.zeros(6, np.float32), "episode": 1}
        for sent in ({**whole, "more": more}, {**whole, "first": None, "prompt": more}):
            socket.send(pack(sent, "openpi"))
            assert unpack(socket.recv(5))["actions"].shape == (1, 2)


@pytest.mark.parametrize("make", [FakePolicy, Chunked])
@pytest.mark.parametrize(
    ("hidden", "said"),
    [
        (lambda images: {"images": images}, "'images'"),
        (lambda images: {"observation": {"images": {"left": images["first"]}}}, "'observation'"),
        (lambda images: {"images": {"first": 1}}, "'images'"),
        (lambda images: {"views": list(images.values())}, "'views'"),
    ],
)
def test_pictures_in_a_table_are_not_taken_for_none(make, hidden, said):
    with serving(make()) as server, connect(server.address) as client:
        client.recv(5)
        sent = {**hidden(look()["images"]), "state": np.zeros(6, np.float32)}
        client.send(pack(sent, "openpi"))
        answer = str(client.recv(5))
    assert f"expected pictures beside 'state', found them in {said}; send each under" in answer


@pytest.mark.parametrize("broken", [[np.nan, 0.0], [0.0, 0.0, 0.0], [[0.0, 0.0]]])
def test_an_action_that_is_none_does_not_go_out(broken, monkeypatch):
    monkeypatch.setattr(Reader, "act", lambda *_: np.array(broken))
    with serving(FakePolicy()) as server, connect(server.address) as client:
        answer = answered(client, "observation", look())
    assert answer["type"] == "error"
    assert "expected a finite action of 2 numbers" in answer["payload"]["error"]


class Seen(FakePolicy):
    """Takes three frames, and keeps what arrived."""

    def __init__(self) -> None:
        super().__init__()
        self.spec = replace(self.spec, image_size=84, frame_stack=3)

    def encode(self, views, state):
        self.views = views
        return super().encode(views, state)


def test_a_camera_that_comes_back_has_no_black_frame_among_its_last_three():
    policy = Seen()
    episodes = ServedEpisodes(policy, 6)
    white = dict.fromkeys(policy.spec.streams, np.full((84, 84, 3), 255, np.uint8))
    for images in (white, {name: white[name] for name in ("third_a", "third_b")}, white):
        episodes.act(images, np.zeros(6))
        assert (policy.views == 255).all() == ("first" in images)
    assert policy.views.shape == (3, 9, 84, 84)


def test_a_picture_that_is_none_is_a_camera_that_is_not_there():
    policy = Seen()
    episodes = ServedEpisodes(policy, 6)
    present = []
    policy.supports = lambda mask: bool(present.append(mask.tolist()) or True)
    episodes.act({**look()["images"], "first": None}, np.zeros(6))
    assert present[-1] == [False, True, True]


@pytest.mark.parametrize(
    "bad",
    [
        look(state=np.full(6, np.nan)),
        look(images={"first": np.zeros((84, 84, 3), np.uint8), "third_b": "x"}),
        look(images={"first": [[[1, 2, 3]], []]}),
        look(state=[[1], [1, 2]]),
    ],
)
def test_a_look_that_is_refused_leaves_nothing_behind(bad):
    policy = Seen()
    episodes = ServedEpisodes(policy, 6)
    white = dict.fromkeys(policy.spec.streams, np.full((84, 84, 3), 255, np.uint8))
    episodes.act(white, np.zeros(6))
    with pytest.raises(BadLook):
        episodes.act(bad["images"], bad["state"])
    episodes.act(white, np.zeros(6))
    assert (policy.views == 255).all()


def test_frames_of_an_answer_that_failed_and_of_a_whole_look_are_those_that_came(monkeypatch):
    policy = Seen()
    episodes = ServedEpisodes(policy, 6)

    def seen(number: int) -> list[int]:
        picture = np.full((84, 84, 3), number, np.uint8)
        episodes.act(dict.fromkeys(policy.spec.streams, picture), np.zeros(6))
        return policy.views[0, ::3, 0, 0].tolist()

    assert seen(1) == [1, 1, 1] and seen(2) == [1, 1, 2]
    with monkeypatch.context() as patch:
        patch.setattr(policy, "read", lambda *_: _raise("nothing"))
        with pytest.raises(UserError, match="nothing"):
            seen(3)
    assert seen(3) == [1, 2, 3], "the look was sent again"
    whole = np.repeat(np.array([5, 6, 7], np.uint8), 3) * np.ones((84, 84, 1), np.uint8)
    episodes.act(dict.fromkeys(policy.spec.streams, whole), np.zeros(6))
    assert seen(8) == [6, 7, 8]


def test_a_state_that_is_no_number_is_named_with_its_place():
    with pytest.raises(BadLook, match="found nan at place 2"):
        ServedEpisodes(FakePolicy(), 6).act(look()["images"], [0, 0, np.nan, 0, 0, 0])


def test_a_look_that_holds_all_frames_needs_no_episode():
    with serving(networks()) as server, connect(server.address) as socket:
        socket.recv(5)
        whole = {name: np.zeros((84, 84, 9), np.uint8) for name in look()["images"]}
        socket.send(pack({**whole, "state": np.zeros(6, np.float32)}, "openpi"))
        assert unpack(socket.recv(5))["actions"].shape == (1, 2)


# --- Who may ask ---


def test_it_serves_this_machine_alone_unless_told_otherwise():
    assert ServeConfig("x").host == "127.0.0.1"
    with serving(FakePolicy()) as server:
        assert server.address.startswith("ws://127.0.0.1:")
        with pytest.raises(InvalidStatus, match="403"):
            connect(server.address, origin="http://127.0.0.1")  # type: ignore[arg-type]


def test_beyond_this_machine_a_token_is_needed():
    with serving(FakePolicy(), token="right") as server:
        for wrong in (server.address, f"{server.address}/?token=wrong"):
            with pytest.raises(InvalidStatus, match="401"):
                connect(wrong)
        connect(server.address, additional_headers={"Authorization": "Api-Key right"}).close()
        address = f"{server.address}/?token=right"
        assert evaluate(address, ["all"], episodes=1, workers=0).rows["all"]["n"] == 1
        with pytest.raises(UserError) as refused:
            load_policy(f"{server.address}/?token=wrong")
        assert "401" in str(refused.value) and "token=" not in str(refused.value)


def test_a_crowd_is_turned_away():
    with serving(FakePolicy()) as server:
        crowd = [connect(server.address) for _ in range(MOST_CLIENTS)]
        with connect(server.address) as late, pytest.raises(ConnectionClosed, match="too many"):
            late.recv(5)
        for one in crowd:
            one.close()


def test_the_end_hangs_up_whoever_is_there():
    server = PolicyServer(FakePolicy()).start()
    with connect(server.address) as socket:
        socket.recv(5)
        server.close()
        with pytest.raises(ConnectionClosed, match="1001"):
            socket.recv(5)


def test_a_player_that_cannot_be_closed_keeps_no_place(monkeypatch):
    monkeypatch.setattr(serve, "MOST_CLIENTS", 1)
    monkeypatch.setattr(Reader, "close", lambda _: _raise("it does not close"))
    with serving(FakePolicy()) as server:
        for _ in range(2):
            with connect(server.address) as socket:
                assert answered(socket, "observation", look())["type"] == "action"
            until(lambda: not server._connections, 5.0)


def test_the_system_looks_whether_a_silent_client_is_still_there(monkeypatch):
    found: Queue[int] = Queue()

    def words(connection):
        found.put(connection.socket.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE))

    monkeypatch.setattr(serve, "_first_words", words)
    with serving(FakePolicy()) as server, connect(server.address):
        assert found.get(timeout=5)


def test_a_place_that_cannot_be_served_is_said():
    with serving(FakePolicy()) as server:
        port = int(server.address.rpartition(":")[2])
        with pytest.raises(UserError, match=f"port {port} on 127.0.0.1 cannot be served"):
            run_serve(ServeConfig("madviz.examples.own_policy:make", port=port))
