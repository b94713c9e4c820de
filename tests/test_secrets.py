"""No secret of an address is on a page, in a file, in a log or in a message."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.visitor import Visitor
from madviz.app.server import ExploreConfig, open_app
from madviz.cli import main
from madviz.errors import UserError
from madviz.measure.audit.audit import AuditConfig, command
from madviz.policies.checkpoint import load_policy
from madviz.system.address import KEPT, ServerAddress, without_secrets
from tests.pages import await_that
from tests.wires import foreign_server, towards_bright, wiring_file

TOKEN = "SECRETTOKEN"
PASSWORD = "SECRETWORD"


@pytest.fixture(autouse=True)
def _no_secrets_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(KEPT, "{}")
    yield


def secret(address: str) -> str:
    return address.replace("ws://", f"ws://me:{PASSWORD}@") + f"/?token={TOKEN}"


def assert_clean(said: str | bytes) -> None:
    data = said if isinstance(said, bytes) else said.encode()
    assert TOKEN.encode() not in data and PASSWORD.encode() not in data


def test_the_text_of_an_address_has_no_secret_and_the_whole_one_has_it_again() -> None:
    for written, text in {
        "ws://127.0.0.1:8208/?token=SECRETTOKEN": "ws://127.0.0.1:8208",
        "wss://me:SECRETWORD@[::1]:8/act?a=1&token=SECRETTOKEN": "wss://[::1]:8/act",
        "ws://host:1": "ws://host:1",
    }.items():
        address = ServerAddress.of(written)
        assert (str(address), address.text, address.whole) == (text, text, written)
        assert_clean(repr(address))
        assert ServerAddress.of(text).whole == written
    assert_clean(ServerAddress.of("ws://[1?token=SECRETTOKEN").text)


def test_a_command_line_has_the_text_alone() -> None:
    words = without_secrets(f"--policy=ws://a:1/p?token={TOKEN}#wire=/home/me/w.toml")
    assert words == "--policy=ws://a:1/p#wire=/home/me/w.toml"


def test_a_servers_own_words_lose_the_secret_that_it_was_sent() -> None:
    address = ServerAddress.of(f"ws://me:{PASSWORD}@a:1/?token={TOKEN}&n=1")
    assert address.hide(f"1 bad token {TOKEN} of me:{PASSWORD}") == "1 bad token *** of ***"


def test_tracebacks_of_a_server_that_repeats_the_token_have_none(tmp_path: Path) -> None:
    def repeats(look: dict[str, Any], connection: Any) -> Any:
        connection.close(1008, f"bad token {TOKEN}")

    with foreign_server(repeats) as address:
        policy = load_policy(f"{secret(address)}#wire={wiring_file(tmp_path)}")
        with pytest.raises(UserError, match=r"\*\*\*") as raised:
            _ask(policy)
    assert_clean("".join(traceback.format_exception(raised.value)))
    with pytest.raises(UserError, match="no connection|expected") as nobody:
        load_policy(f"ws://h:x/?token={TOKEN}")
    assert_clean("".join(traceback.format_exception(nobody.value)))


def _ask(policy: Any) -> None:
    import numpy as np

    spec = policy.spec
    views = np.zeros((len(spec.streams), 3, spec.image_size, spec.image_size), np.uint8)
    policy.read(policy.encode(views, np.zeros(4, np.float32)), np.ones((1, len(views)), bool))


def test_commands_write_print_and_log_no_secret(
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    caplog.set_level(logging.DEBUG)
    here = ["--workers", "0"]
    with foreign_server(towards_bright) as address:
        words = ["--policy", secret(address), "--wire", str(wiring_file(tmp_path))]
        some = ["--how", "black", "--episodes", "1", "--out", str(tmp_path / "a")]
        assert main(["audit", *words, *some, *here]) == 0
        few = ["--subsets", "all", "--episodes", "1", "--json", str(tmp_path / "e.json")]
        assert main(["eval", *words, *few, *here]) == 0
        assert main(["record", *words, "--steps", "2", "--out", str(tmp_path / "r.html")]) == 0
    said = capfd.readouterr()
    assert_clean(said.out + said.err)
    for record in caplog.records:
        if not record.name.startswith("websockets.server"):  # The server knows what it was sent.
            assert_clean(record.getMessage())
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert {"audit.html", "audit.md", "e.json", "r.html"} <= {file.name for file in files}
    for file in files:
        assert_clean(file.read_bytes())
    page = (tmp_path / "a" / "audit.html").read_text()
    assert str(tmp_path) not in page and "wire.toml" in page and address in page


def test_an_audit_that_was_stopped_names_whole_paths_on_its_own_terminal(tmp_path: Path) -> None:
    config = AuditConfig(f"ws://a:1/?token={TOKEN}", tmp_path / "a", wire=tmp_path / "w.toml")
    assert str(tmp_path / "a") in command(config, given_away=False)
    assert_clean(command(config, given_away=False) + command(config))


class Listening(Visitor):
    """Keeps every byte that the page sends, unpacked."""

    heard: bytes = b""

    def _take(self, data: bytes) -> None:
        size = int.from_bytes(data[8:16], "little")
        self.heard += self._unpack.decompress(data[16 : 16 + size])
        super()._take(data)


def test_no_message_to_a_browser_has_a_secret_or_a_path(tmp_path: Path) -> None:
    with foreign_server(towards_bright) as address:
        app = open_app(
            ExploreConfig(policy=secret(address), port=0, workers=0, wire=wiring_file(tmp_path))
        )
        try:
            visitor = Listening(app.url)
            with visitor:
                await_that(lambda: len(visitor.steps) > 3 and visitor.find("Policy"))
            picker = visitor.controls[visitor.find("Policy")[0]]
            assert picker["value"] == f"{address}#wire=wire.toml"
            assert_clean(visitor.heard)
            assert str(tmp_path).encode() not in visitor.heard
        finally:
            app.stop()
