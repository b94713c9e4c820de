"""Who gets in, who presents, and what a hostile page can do: nothing to anybody else."""

from __future__ import annotations

import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import msgspec.msgpack
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from benchmarks.visitor import Visitor
from madviz.app.access import (
    TRIES,
    Gate,
    Tries,
    _is_owned,
    cookie_name,
)
from madviz.app.server import App, ExploreConfig, gate_for
from madviz.app.users import Limits
from madviz.errors import UserError
from madviz.system.hosts import new_token, same_token, stays_here
from tests.pages import fake_app, seats, until

NAMES = ("toy-mad", "toy-other")


class NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None


def get(url: str, cookie: str = "") -> tuple[int, str, str]:
    """Status, text and headers of an address."""
    request = urllib.request.Request(url, headers={"Cookie": cookie} if cookie else {})
    try:
        answer = urllib.request.build_opener(NoRedirect).open(request, timeout=30)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        return answer.status or 0, answer.read().decode("utf-8", "replace"), str(answer.headers)


@pytest.fixture(scope="module")
def closed() -> Iterator[App]:
    """A page behind a token."""
    app = fake_app(*NAMES, gate=Gate(visit="right"))
    yield app
    app.stop()


@pytest.fixture(scope="module")
def shown() -> Iterator[App]:
    """A presentation whose watchers need no token; two may watch."""
    gate = Gate(present="mine")
    app = fake_app(*NAMES, gate=gate, limits=Limits(watchers=2), speed=20.0)
    yield app
    app.stop()


@pytest.fixture(scope="module")
def open_() -> Iterator[App]:
    app = fake_app(*NAMES, limits=Limits(visitors=3), speed=20.0)
    yield app
    app.stop()


def cookie(app: App, token: str) -> str:
    return f"{cookie_name(app.server.get_port())}={token}"


def test_only_other_machines_need_a_token():
    assert stays_here("127.0.0.1") and stays_here("localhost") and stays_here("127.8.0.1")
    assert not stays_here("0.0.0.0") and not stays_here("192.168.1.5") and not stays_here("box")
    assert gate_for(ExploreConfig()).visit is None
    assert gate_for(ExploreConfig(host="0.0.0.0")).visit is not None
    assert gate_for(ExploreConfig(host="0.0.0.0", token=False)).visit is None
    both = gate_for(ExploreConfig(host="0.0.0.0", present=True))
    assert both.visit and both.present and both.visit != both.present


def test_a_token_is_long_and_compared_whole():
    assert new_token() != new_token() and len(new_token()) >= 22
    assert same_token("abc", "abc") and not same_token("ab", "abc") and not same_token("", "abc")
    assert not same_token("", None) and not same_token("é", "e")


def test_a_few_wrong_tries_a_second():
    now = [0.0]
    tries = Tries(lambda: now[0])
    for number in range(TRIES):
        assert not tries.too_many("here")
        tries.note("here", f"wrong {number}")
    assert tries.too_many("here") and not tries.too_many("there")
    now[0] = 1.1
    assert not tries.too_many("here")
    for number in range(5000):
        tries.note(str(number), "wrong")
    assert len(tries._wrong) <= 1000


def test_stale_tabs_that_say_the_same_again_are_one_try():
    tries = Tries(lambda: 0.0)
    for _ in range(10 * TRIES):
        tries.note("behind a proxy", "the token before the restart")
    assert not tries.too_many("behind a proxy")


@pytest.mark.parametrize(
    ("origin", "forwarded", "welcome"),
    [
        (None, None, True),
        ("http://{here}", None, True),
        ("https://evil.example", None, False),
        ("http://{here}.evil.example", None, False),
        ("null", None, False),
        ("http://[", None, False),
        ("https://hub.example", "hub.example", True),
        ("https://evil.example", "hub.example", False),
    ],
)
def test_a_page_of_another_site_opens_nothing_here(
    open_: App, origin: str | None, forwarded: str | None, welcome: bool
):
    here = open_.url.removeprefix("http://")
    headers = {"X-Forwarded-Host": forwarded} if forwarded else {}
    if origin:
        headers["Origin"] = origin.format(here=here)
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    try:
        connect(f"ws://{here}", subprotocols=spoken, additional_headers=headers).close()
        came_in = True
    except InvalidStatus as error:
        came_in = False
        assert error.response.status_code == 403 and b"another site" in error.response.body
    assert came_in == welcome


@pytest.mark.parametrize(
    ("host", "forwarded", "welcome"),
    [
        ("127.0.0.1:{port}", None, True),
        ("127.5.0.1:{port}", None, True),
        ("localhost:{port}", None, True),
        ("LOCALHOST.:{port}", None, True),
        ("[::1]:{port}", None, True),
        ("madviz.localhost:{port}", None, True),
        ("127.0.0.1:9000", None, True),  # A tunnel to another port.
        ("192.168.1.5:{port}", None, True),  # Or one that others may use: a number is nobody's.
        ("evil.example:{port}", None, False),
        ("127.0.0.1.evil.example:{port}", None, False),
        ("localhost.evil.example:{port}", None, False),
        ("box:{port}", None, False),
        # A notebook's server, which passes its own name on, and one behind a hub.
        ("box:8888", None, True),
        ("hub.example", None, True),
        ("hub.example:443", None, True),
        ("hub.example:{port}", "X-Forwarded-For", True),
    ],
)
def test_who_owns_a_name_cannot_let_it_point_here(
    open_: App, host: str, forwarded: str | None, welcome: bool
):
    port = open_.server.get_port()
    host = host.format(port=port)
    headers = {"Origin": f"http://{host}", **({forwarded: "10.0.0.1"} if forwarded else {})}
    spoken = [Subprotocol(f"viser-v{viser.__version__}")]
    direct = socket.create_connection(("127.0.0.1", port))
    try:
        connect(
            f"ws://{host}", sock=direct, subprotocols=spoken, additional_headers=headers
        ).close()
        came_in = True
    except InvalidStatus as error:
        came_in = False
        assert error.response.status_code == 403
        assert f"open it as http://127.0.0.1:{port}".encode() in error.response.body
    assert came_in == welcome


def test_only_a_page_for_this_machine_alone_minds_its_name(open_: App):
    asked = urllib.request.Request(
        open_.url, headers={"Host": f"evil.example:{open_.server.get_port()}"}
    )
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(asked, timeout=30)
    assert _is_owned("evil.example", 80) and not _is_owned("evil.example", 8080)
    assert _is_owned("evil.example:x", 8080) and not _is_owned("localhost", 80)
    assert gate_for(ExploreConfig()).local and open_.gate.local
    assert not gate_for(ExploreConfig(host="0.0.0.0", token=False)).local
    open_.gate.local = False
    try:
        assert urllib.request.urlopen(asked, timeout=30).status == 200
    finally:
        open_.gate.local = True


def test_without_the_token_not_a_byte_of_the_page(closed: App):
    for path in ("/", "/index.html", "/assets/x.js", "//", "/?fixedDpr=1"):
        status, text, _ = get(closed.url + path)
        assert status == 401 and 'name="token"' in text and "<script" not in text
    with pytest.raises(UserError, match="401"):
        Visitor(closed.url)
    assert not closed.server.get_clients()


def test_a_wrong_token_is_refused_and_soon_not_even_compared(closed: App):
    closed.gate.tries = Tries()
    answers = [get(f"{closed.url}/?token=wrong{n}")[0] for n in range(TRIES + 2)]
    assert answers[0] == 403 and 429 in answers[TRIES - 1 :]
    # While it waits, the right one is not looked at either.
    assert get(closed.url, cookie(closed, "wrong"))[0] in (401, 429)
    closed.gate.tries = Tries()
    with pytest.raises(UserError, match="40[13]"):
        Visitor(closed.url, cookie(closed, "wrong"))
    closed.gate.tries = Tries()


def test_the_right_token_becomes_a_cookie_and_leaves_the_address(closed: App):
    status, _, headers = get(f"{closed.url}/?token=right&fixedDpr=0.5")
    assert status == 303 and "Location: ./?fixedDpr=0.5" in headers
    assert f"{cookie(closed, 'right')}; Path=/; HttpOnly; SameSite=Lax" in headers
    assert get(closed.url, cookie(closed, "right"))[0] == 200
    with Visitor(closed.url, cookie(closed, "right")) as visitor:
        until(lambda: visitor.steps and visitor.controls)


def test_addresses_say_who_opens_what(closed: App, shown: App):
    assert closed.addresses() == {"madviz is at": f"{closed.url}/?token=right"}
    assert shown.addresses() == {
        "present at": f"{shown.url}/?token=mine",
        "watch at": shown.url,
    }


def test_one_presents_and_the_others_watch(shown: App):
    with Visitor(shown.url) as watcher:
        until(lambda: watcher.steps and watcher.shown("presenter has the controls"))
        with Visitor(shown.url, cookie(shown, "mine")) as presenter:
            until(lambda: presenter.find("Episode") and presenter.steps)
            for label in (
                "Policy",
                "Episode",
                "Speed",
                "Seed",
                "First person",
                "Step",
                "start",
                "start B",
            ):
                until(lambda label=label: presenter.find(label))
                assert not watcher.find(label), label
            (row,) = presenter.find("Episode")
            presenter.set(row, "pause")
            until(lambda: watcher.shown('data-phase="paused"'))
        # The presenter loads the page again.
        until(lambda: seats(shown.users) == (0, 1, 0))
        with Visitor(shown.url, cookie(shown, "mine")) as presenter:
            until(lambda: presenter.find("Episode"))
            assert presenter.shown('data-phase="paused"') or not presenter.steps
            presenter.set(presenter.find("Episode")[0], "▶ play")
            until(lambda: watcher.shown('data-phase="playing"'))
            assert seats(shown.users) == (1, 1, 0)
    until(lambda: seats(shown.users) == (0, 0, 0))
    with Visitor(shown.url) as late:  # It goes on while nobody watches.
        until(lambda: late.shown('data-phase="playing"'))


def test_watchers_beyond_the_limit_wait_until_somebody_leaves(shown: App):
    with Visitor(shown.url) as first, Visitor(shown.url) as second:
        until(lambda: first.steps and second.steps)
        with Visitor(shown.url) as third:
            until(lambda: third.shown("All 2 places"))
            assert not third.steps
            with Visitor(shown.url, cookie(shown, "mine")) as presenter:
                until(lambda: presenter.find("Episode"))  # There is always room for the presenter.
            first.close()
            until(lambda: bool(third.steps))
            assert not third.shown("All 2 places")
    until(lambda: seats(shown.users) == (0, 0, 0))


def encoded(**message) -> bytes:
    return msgspec.msgpack.encode(message)


GARBAGE = (
    b"",
    b"\xff" * 5000,
    b"\x00",
    "text instead of bytes",
    encoded(type="NoSuchMessage"),
    encoded(nothing=1),
    msgspec.msgpack.encode([1, 2, 3]),
    encoded(type="GuiUpdateMessage", uuid=7),
    encoded(type="ViewerCameraMessage", wxyz="no"),
    encoded(type="RunJavascriptMessage", source="alert(1)"),
    b"\x93" * 2_000_000,
)


def test_garbage_costs_its_sender_the_connection_and_nobody_else_anything(open_: App):
    with Visitor(open_.url) as other:
        until(lambda: bool(other.steps))
        for garbage in GARBAGE:
            with Visitor(open_.url) as hostile:
                hostile.send_raw(garbage)
                time.sleep(0.05)
        seen = len(other.steps)
        until(lambda: len(other.steps) > seen + 3)
        assert not other.ended
        until(lambda: seats(open_.users) == (1, 0, 0))


ABSURD = (1e308, -1e308, float("nan"), float("inf"), 2**63, "words", None, [], {}, True, [1] * 999)


def test_absurd_values_do_no_harm(open_: App):
    with Visitor(open_.url) as other, Visitor(open_.url) as hostile:
        until(lambda: other.steps and hostile.find("Episode"))
        for uuid in list(hostile.controls):
            label = hostile.controls[uuid]["props"].get("label")
            if label in ("start", "watch", "save this episode", "save the last 20"):
                continue
            for value in ABSURD:
                hostile.set(uuid, value)
            hostile.set(uuid, "x", prop="no_such_property")
        hostile.set("no-such-widget", 1)
        seen = len(other.steps)
        until(lambda: len(other.steps) > seen + 3)
        assert not other.shown("STOPPED")
    with Visitor(open_.url) as fresh:
        until(lambda: bool(fresh.steps))


def test_bytes_that_are_no_request_at_all(open_: App):
    with socket.create_connection(("127.0.0.1", open_.server.get_port()), timeout=10) as raw:
        raw.sendall(b"\x16\x03\x01 not http\r\n\r\n")
        raw.settimeout(10)
        try:
            raw.recv(1000)
        except OSError:
            pass
    with Visitor(open_.url) as visitor:
        until(lambda: bool(visitor.steps))


@pytest.mark.parametrize("length", [300, 4000, 8000])
def test_an_address_that_no_file_can_have_is_refused(closed: App, length: int) -> None:
    for page in (f"{closed.url}/{'x' * length}", f"{closed.url}/a/{'x' * length}?b=c"):
        assert get(page, "")[0] == 414


def test_a_machine_with_many_accounts_asks_for_its_own_token(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MADVIZ_TOKEN", "given")
    gate = gate_for(ExploreConfig())
    assert (gate.visit, gate.local) == ("given", True)
    assert gate_for(ExploreConfig(host="0.0.0.0")).visit == "given"
    assert gate_for(ExploreConfig(token=False)).visit is None
    app = fake_app(*NAMES, gate=gate)
    try:
        assert get(app.url)[0] == 401 and get(app.url, cookie(app, "given"))[0] == 200
    finally:
        app.stop()
