"""Policies of others, over a websocket: what is said, what is shown, and what goes wrong."""

from __future__ import annotations

import io
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image
from websockets.http11 import Request
from websockets.server import ServerProtocol
from websockets.sync.server import ServerConnection

from madviz.app.panels.cameras import unused_note
from madviz.app.panels.policy import status_html
from madviz.app.panels.subsets import subsets_html
from madviz.cli import main
from madviz.errors import Unfinished, UserError
from madviz.measure.evaluate import EvalConfig, evaluate, run_eval
from madviz.policies.checkpoint import load_policy
from madviz.session.commands import Fork, Pause, Play, Scrub, SetCamera
from madviz.subsets import name_of
from madviz.system.address import ServerAddress
from madviz.wire.codec import DEEPEST, BadMessage, pack, unpack
from madviz.wire.connection import PolicyConnection
from madviz.wire.policy import noise_at
from madviz.wire.reference import plain, with_wire
from tests.sessions import BLACK, OFF, Recorder
from tests.wires import foreign_server, towards_bright, wiring_file

PROTOCOLS = ["vla-eval", "openpi"]


def wired(address: str, folder, **changed: str | None) -> str:
    return with_wire(address, wiring_file(folder, **changed))


# --- The bytes ---


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays_come_back_as_they_were(protocol):
    rng = np.random.default_rng(0)
    message = {
        "picture": rng.integers(0, 255, (4, 5, 3), np.uint8),
        "deep": {"state": rng.normal(size=7).astype(np.float32), "on": np.array([True, False])},
        "list": [1, "two", np.float64(0.5)],
    }
    back = unpack(pack(message, protocol))
    np.testing.assert_array_equal(back["picture"], message["picture"])
    np.testing.assert_array_equal(back["deep"]["state"], message["deep"]["state"])
    assert back["deep"]["on"].dtype == bool and back["list"] == [1, "two", 0.5]


def test_a_picture_with_a_broken_chunk_is_refused():
    file = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(file, "PNG")
    torn = bytearray(file.getvalue())
    torn[36] = 0
    sent = {"__image__": True, "format": "png", "data": bytes(torn)}
    with pytest.raises(BadMessage, match="no png"):
        unpack(msgspec.msgpack.encode({"a": sent}))


def test_pictures_may_come_as_png():
    picture, file = np.arange(48, dtype=np.uint8).reshape(4, 4, 3), io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    sent = {"__image__": True, "format": "png", "data": file.getvalue(), "shape": [4, 4, 3]}
    np.testing.assert_array_equal(unpack(msgspec.msgpack.encode({"a": sent}))["a"], picture)


ARRAY = {"__ndarray__": True, "data": bytes(8), "dtype": "<f4", "shape": [2]}
TRAPS = {
    "a gigabyte": (ARRAY | {"shape": [2**28]}, "the shape"),
    "more than there is": (ARRAY | {"shape": [2**62, 2**62]}, "the shape"),
    "a negative size": (ARRAY | {"shape": [-2]}, "the shape"),
    "objects": (ARRAY | {"dtype": "O"}, "no plain numbers"),
    "a program": (ARRAY | {"dtype": "(3,)f4, __import__('os')"}, "kind"),
    "sides past counting": (ARRAY | {"data": b"", "shape": [0, 2**62, 2**62]}, "the shape"),
    "a kind that is a number": (ARRAY | {"dtype": 4}, "without a kind"),
    "a size that is no number": (ARRAY | {"shape": [True, 2]}, "the shape"),
    "no bytes": (ARRAY | {"data": "text"}, "without data"),
    "a kind of picture": ({"__image__": True, "format": "pkl", "data": b""}, "unknown format"),
    "a torn picture": ({"__image__": True, "format": "png", "data": b"x"}, "no png"),
}


@pytest.mark.parametrize("trap", TRAPS.values(), ids=TRAPS)
def test_what_lies_about_itself_is_refused(trap):
    with pytest.raises(BadMessage, match=trap[1]):
        unpack(msgspec.msgpack.encode({"a": trap[0]}))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x91" * 100_000 + b"\x01",
        b"\xdd\x40\x00\x00\x00",
        b"\xc6\x40\x00\x00\x00",
        "Traceback",
    ],
    ids=["nothing", "deep", "2^30 of them", "1 GB of bytes", "a text"],
)
def test_bytes_that_are_no_message_are_refused(data):
    with pytest.raises(BadMessage):
        unpack(data)


def test_tables_may_be_nested_only_so_deep():
    deep: Any = 1
    for _ in range(DEEPEST + 2):
        deep = {"a": deep}
    with pytest.raises(BadMessage, match="deeper than"):
        unpack(msgspec.msgpack.encode(deep))


# --- How it is wired ---


@pytest.mark.parametrize("key", ["task", "size", "state", "masks", "cameras"])
def test_a_missing_key_is_named_before_anything_is_connected(key, tmp_path):
    with pytest.raises(UserError, match=f"expected '{key}', found none"):
        load_policy(wired("ws://127.0.0.1:1", tmp_path, **{key: None}))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"sizes": "3"}, "unknown word 'sizes'.*did you mean size"),
        ({"masks": '"no"'}, "expected 'masks' to be true or false"),
        ({"protocol": '"ros"'}, "expected 'protocol' to be openpi or vla-eval"),
        ({"task": '"toy/run"'}, "unknown task 'toy/run'"),
        ({"cameras": '{ left = "x" }'}, r"unknown camera in \[cameras\] 'left'"),
        ({"size": "{ first = 84 }"}, "expected 'size.third_a', found none"),
        ({"size": "640"}, "'size' to be a whole number <= 512, found 640"),
        ({"size": "{ first = 84, third_a = 640 }"}, "'size.*' to be a whole number <= 512"),
        ({"size": "[84]"}, "size"),
        ({"size": "[48, 64]"}, "the size of 'first' to be a square, as 48 by 48, found 48 by 64"),
        (
            {"size": "{ first = 84, third_a = [64, 48] }"},
            "'third_a' .* found 64 by 48; say letterb",
        ),
        ({"modality": '{ fist = "depth" }'}, r"unknown camera in \[modality\] 'fist'"),
    ],
)
def test_a_key_that_will_not_do_is_named(changed, said, tmp_path):
    with pytest.raises(UserError, match=said):
        load_policy(wired("ws://127.0.0.1:1", tmp_path, **changed))


def test_a_file_beside_no_address_is_refused(tmp_path):
    with pytest.raises(UserError, match="--wire is for --policy ws://"):
        with_wire("metaworld-hammer-mad-light", tmp_path / "x.toml")
    assert plain("ws://me:secret@a:1/p?token=T#wire=/home/me/w.toml") == "ws://a:1/p#wire=w.toml"


def test_a_stranger_must_be_wired():
    with foreign_server(towards_bright) as address:
        with pytest.raises(UserError, match=f"{address}: expected a server that says how.*--wire"):
            load_policy(address)


def test_a_camera_beside_its_own_depth_is_another_stream_and_both_have_its_name(tmp_path):
    cameras = '{ first = "wrist", "first.depth" = "deep", third_a = "front" }'
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        looks.append(look["images"])
        return {"actions": np.zeros(2)}

    with foreign_server(answer) as address:
        policy = load_policy(wired(address, tmp_path, cameras=cameras))
        assert policy.spec.streams == ("first.rgb", "first.depth", "third_a")
        assert name_of(np.array([1, 1, 0], bool), policy.spec.streams) == "first"
        evaluate(policy, ["first", "first.rgb"], episodes=1)
    assert [set(each) for each in looks[::25]] == [{"wrist", "deep"}, {"wrist"}]
    cameras = cameras.replace("{", '{ "first.rgb" = "again",')
    with pytest.raises(UserError, match="each stream once.*'cameras.first', which both send"):
        load_policy(wired(address, tmp_path, cameras=cameras))


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_pictures_state_and_words_arrive_under_their_names(protocol, tmp_path):
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        looks.append(look)
        return {"move": [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]}

    file = {
        "size": "{ first = 84, third_a = 128 }",
        "cameras": '{ first = ["hand", "eye"], third_a = "front" }',
        "state": '"joints"',
        "action": '"move"',
        "instruction": '"go there"',
        "modality": '{ third_a = "depth" }',
        "chunk": "2",
        "noise": '"noise"',
    }
    with foreign_server(answer, protocol) as address:  # type: ignore[arg-type]
        policy = load_policy(wired(address, tmp_path, **file))
        assert policy.spec.streams == ("first", "third_a.depth") and policy.spec.chunk == 2
        result = evaluate(policy, ["all", "first"], episodes=1, seed=7)
    assert len(result.episodes) == 2 and len(looks) == 2 * 13, "25 decisions are 13 looks"
    images = looks[0]["images"] if protocol == "vla-eval" else looks[0]
    assert images["hand"]["eye"].shape == (84, 84, 3) and images["front"].shape == (128, 128, 3)
    assert looks[0]["joints"].shape == (6,)
    assert looks[0]["task_description" if protocol == "vla-eval" else "prompt"] == "go there"
    alone = looks[13]["images"] if protocol == "vla-eval" else looks[13]
    assert "hand" in alone and "front" not in alone, "a camera that is dropped is not sent"
    noise = [look["noise"] for look in looks]
    assert noise[:13] == noise[13:] == [noise_at(7, step) for step in range(0, 25, 2)]


def test_what_was_read_before_changes_no_noise_of_an_episode(tmp_path):
    noise: list[int] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        noise.append(look["noise"])
        return {"actions": np.zeros(2)}

    with foreign_server(answer, "openpi") as address:
        policy = load_policy(wired(address, tmp_path, noise='"noise"'))
        player = policy.reset(7)  # type: ignore[attr-defined]
        mask = np.ones(2, bool)
        for _ in range(2):
            encoded = policy.encode(np.zeros((2, 3, 84, 84), np.uint8), np.zeros(6, np.float32))
            policy.read(encoded, mask)
            player.act(encoded, mask)
        player.close()
    assert noise == [0, noise_at(7, 0), 0, noise_at(7, 1)]


def test_a_picture_that_is_no_square_stands_between_black_bars(tmp_path):
    looks: list[dict[str, Any]] = []

    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        looks.append(look["images"])
        return {"actions": np.zeros(2)}

    file = {"size": "{ first = [48, 64], third_a = [512, 8] }", "letterbox": "true"}
    with foreign_server(answer) as address:
        policy = load_policy(wired(address, tmp_path, **file))
        assert policy.spec.image_size == 48
        views = np.full((2, 9, 48, 48), 200, np.uint8)
        policy.read(policy.encode(views, np.zeros(6, np.float32)), np.ones(2, bool))
    (images,) = looks
    wide, high = images["wrist"], images["front"]
    assert wide.shape == (48, 64, 9) and high.shape == (512, 8, 9)
    assert (wide[:, 8:56] == 200).all() and wide.sum() == 200 * 48 * 48 * 9
    assert (high[252:260] == 200).all() and high.sum() == 200 * 8 * 8 * 9


def test_who_cannot_leave_a_camera_out_says_so(tmp_path):
    with foreign_server(towards_bright) as address:
        policy = load_policy(wired(address, tmp_path, masks="false"))
        assert not policy.spec.can_drop
        with pytest.raises(UserError, match="cannot act on 'first'"):
            evaluate(policy, ["first"], episodes=1)
        assert list(evaluate(policy, episodes=1).rows) == ["all"]
        session = Recorder(policy)
        session.at(0.0)
        note = unused_note(session.ask(SetCamera("first", BLACK)))
        assert "none can be left out" in note and "mean picture" in note


# --- On the page ---


def test_the_page_reads_what_is_seen_and_shows_no_q_and_no_features(tmp_path):
    with foreign_server(towards_bright) as address:
        session = Recorder(load_policy(wired(address, tmp_path)))
        session.at(0.0)
        session.steps(2)
        frame = session.ask(Pause(), SetCamera("first", OFF))
        assert not frame.pace.error and frame.action[0] == -0.5
        html = status_html(frame) + subsets_html(frame)
        assert "Q <b>" not in html and "not read" in html and "nan" not in html


def test_a_step_that_is_gone_back_to_has_its_chunk_again(tmp_path):
    def answer(look: dict[str, Any], connection: ServerConnection) -> dict[str, Any]:
        now = float(look["images"]["wrist"].mean()) / 255
        return {"actions": np.array([[now, i / 10] for i in range(5)], np.float32)}

    with foreign_server(answer) as address:
        policy = load_policy(wired(address, tmp_path, chunk="5"))
        straight, forked = Recorder(policy, seed=2003), Recorder(policy, seed=2003)
        for session in (straight, forked):
            session.at(0.0)
            session.steps(8)
        forked.ask(Scrub(6), Fork())
        forked.steps(2)
        straight.steps(0)
        assert not forked.frames[-1].pace.error
        one, other = straight.frames[-1].world, forked.frames[-1].world
        assert (one.step, one.planned) == (other.step, other.planned) == (8, 2)
        np.testing.assert_array_equal(one.hand, other.hand)


# --- What goes wrong ---


def huge(look: Any, connection: ServerConnection) -> None:
    """Announces 1 GB in the frame's own header, and sends nothing of it."""
    connection.socket.sendall(b"\x82\x7f" + (2**30).to_bytes(8, "big"))


def deep(look: Any, connection: ServerConnection) -> None:
    connection.send(b"\x91" * 100_000 + b"\x01")


def slow(look: Any, connection: ServerConnection) -> None:
    time.sleep(1.6)


def gone(look: Any, connection: ServerConnection) -> None:
    connection.socket.shutdown(socket.SHUT_RDWR)


def says(actions: Any) -> Callable[[Any, ServerConnection], Any]:
    return lambda look, connection: {"actions": actions}


BROKEN: dict[str, tuple[Callable[[Any, ServerConnection], Any], str]] = {
    "gone": (gone, "expected an action, found that the connection was closed"),
    "slow": (slow, "expected an action within 0.8 s, found nothing; see `timeout` of --wire"),
    "1 GB": (huge, "expected an action, found a message of more than 64 MB"),
    "deep": (deep, "expected an action, found 100001 bytes that are no msgpack"),
    "text": (lambda _, c: c.send("Traceback\nKeyError: 3"), "found the text 'KeyError: 3'"),
    "shape": (says(np.zeros(3)), r"expected 'actions' of 2 finite numbers.*the shape \(3,\)"),
    "cube": (says(np.zeros((1, 5, 2))), r"found the shape \(1, 5, 2\)"),
    "empty": (says(np.zeros((0, 2))), r"found the shape \(0, 2\)"),
    "NaN": (says(np.array([0.0, np.nan])), "found NaN or infinity"),
    "words": (says("left"), "found something that is no number"),
    "other": (lambda *_: {"move": 1}, "found an answer with move"),
    "list": (lambda _, c: c.send(pack([1, 2], "vla-eval")), "found a message that is no table"),
}


@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN)
def test_a_server_that_breaks_is_named_and_nothing_finished_is_lost(broken, tmp_path):
    """Two episodes go well, the third breaks off in the middle."""
    looks = 0

    def answer(look: dict[str, Any], connection: ServerConnection) -> Any:
        nonlocal looks
        looks += 1
        return (towards_bright if looks <= 60 else broken[0])(look, connection)

    with foreign_server(answer) as address:
        reference = wired(address, tmp_path, timeout="0.8")
        with pytest.raises(Unfinished, match=f"{re.escape(address)}: .*{broken[1]}") as stopped:
            evaluate(reference, ["all"], episodes=4, workers=0)
        assert "2 of 4 episodes are done" in str(stopped.value)
        assert stopped.value.result.rows["all"]["n"] == 2


@pytest.mark.parametrize("broken", BROKEN.values(), ids=BROKEN)
def test_the_page_survives_it_and_goes_on_when_the_server_does(broken, tmp_path):
    mode = ["well"]

    def answer(look: dict[str, Any], connection: ServerConnection) -> Any:
        return (towards_bright if mode[0] == "well" else broken[0])(look, connection)

    with foreign_server(answer) as address:
        session = Recorder(load_policy(wired(address, tmp_path, timeout="0.8")))
        session.at(0.0)
        session.steps(3)
        mode[0] = "broken"
        session.steps(1)
        error = session.frames[-1].pace.error.splitlines()[0]
        assert address in error and re.search(broken[1], error)
        assert session.frames[-1].pace.phase == "paused" and session.frames[-1].world.step >= 3
        mode[0] = "well"
        session.ask(Play())
        frame = session.steps(2)
        assert not frame.pace.error and frame.world.step >= 4


def test_what_was_finished_is_written(tmp_path, capsys):
    looks = 0

    def answer(look: dict[str, Any], connection: ServerConnection) -> Any:
        nonlocal looks
        looks += 1
        return (towards_bright if looks <= 30 else gone)(look, connection)

    with foreign_server(answer) as address:
        file = wiring_file(tmp_path)
        words = ["--wire", str(file), "--subsets", "all", "--episodes", "2", "--workers", "0"]
        out = tmp_path / "out.json"
        assert main(["eval", "--policy", address, *words, "--json", str(out)]) == 2
        assert msgspec.json.decode(out.read_bytes())["subsets"]["all"]["n"] == 1
        assert "1 of 2 episodes are done" in capsys.readouterr().err


def test_a_server_that_reads_nothing_is_named_in_time():
    listening = socket.create_server(("127.0.0.1", 0))

    def greet() -> None:
        line = listening.accept()[0]
        protocol = ServerProtocol()
        protocol.receive_data(line.recv(10_000))
        (request,) = protocol.events_received()
        assert isinstance(request, Request)
        protocol.send_response(protocol.accept(request))
        line.sendall(b"".join(protocol.data_to_send()))
        kept.append(line)

    kept: list[socket.socket] = []
    thread = threading.Thread(target=greet)
    thread.start()
    address = ServerAddress.of(f"ws://127.0.0.1:{listening.getsockname()[1]}")
    connection = PolicyConnection(address, timeout=0.2)
    try:
        connection.open()
        with pytest.raises(UserError, match="a server that reads within 0.2 s, found one"):
            connection.tell({"picture": bytes(20_000_000)}, "vla-eval")
        assert not connection.is_open
    finally:
        thread.join(5)
        for each in (*kept, listening):
            each.close()


def test_nobody_there_is_said_in_one_sentence(tmp_path):
    config = EvalConfig("ws://127.0.0.1:9", wire=wiring_file(tmp_path))
    with pytest.raises(UserError, match="ws://127.0.0.1:9: expected a policy that is served"):
        run_eval(config)


def test_every_command_that_takes_a_policy_takes_one_that_is_served(tmp_path, capsys):
    with foreign_server(towards_bright) as address:
        wire = ["--wire", str(wiring_file(tmp_path))]
        here = ["--workers", "0"]
        pair = ["--conditions", "all", "black:first", "--episodes", "2", *here]
        assert main(["compare", address, *wire, *pair]) == 0
        assert f"{address} on toy/reach" in capsys.readouterr().out
        words = ["--policy", address, *wire]
        assert main(["record", *words, "--steps", "3", "--out", str(tmp_path / "a.html")]) == 0
        some = ["--episodes", "1", "--how", "black", *here, "--out", str(tmp_path / "audit")]
        assert main(["audit", *words, *some]) == 0
        assert (tmp_path / "audit" / "audit.html").is_file()
