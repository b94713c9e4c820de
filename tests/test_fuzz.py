"""Inputs that nobody thought of, made by Hypothesis: whatever comes from a file, a page or a
command line is taken, or refused in one line.

Each fuzzer begins with something sound and changes it in a few places. The fast test tries a few
hundred inputs, the same ones every time; the slow one thousands, others each time.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec.msgpack
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from viser.infra._messages import wire_field_names

from benchmarks.__main__ import BENCHMARKS
from benchmarks.__main__ import main as benchmark
from benchmarks.visitor import Visitor
from madviz import cli
from madviz.app import connection
from madviz.app.connection import TAKEN
from madviz.app.server import App
from madviz.app.users import Limits
from madviz.envs.cameras import read_cameras
from madviz.errors import UserError
from madviz.observation.grammar import failure_text, parse_failure
from madviz.observation.schedule import parse_schedule, schedule_words
from madviz.policies import checkpoint
from madviz.policies.checkpoint import describe, shipped_evaluation
from madviz.policies.listing import ListConfig, catalogue, list_policies, run_list
from madviz.session.session_reader import parse
from madviz.system.options import options
from madviz.system.plugins import load
from tests.pages import fake_app, until
from tests.test_messages import KINDS, sample
from tests.test_saved_session_files import document

CHECKPOINTS = Path(__file__).parent.parent / "checkpoints"
FAST, LONG = 150, 5000
"""Inputs for each fuzzer; less where one input takes long."""

NUMBERS = st.one_of(
    st.integers(-2, 3),
    st.sampled_from([2**31, 2**63, 2**64, -(2**63) - 1, 10**30, 10**400]),
    st.floats(),
    st.sampled_from([1e308, -0.0, 1e-320]),
)
TEXTS = st.one_of(
    st.text(max_size=12),
    st.sampled_from(
        ["../x", "a/b", "os:system", "\x00", "\ud800", "\n", "x" * 5000, "nan", "1e999"]
    ),
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=8,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every path into a document."""
    if not isinstance(value, dict | list):
        return [path]
    inside = value.items() if isinstance(value, dict) else enumerate(value)
    return [path, *(place for key, inner in inside for place in places(inner, (*path, key)))]


@st.composite
def changed(draw: st.DrawFn, sound: Callable[[], Any]) -> Any:
    """``sound()`` with up to three values replaced, removed, added or doubled."""
    found = copy.deepcopy(sound())
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(places(found)))
        if not path:
            found = draw(VALUES) if draw(st.integers(0, 9)) == 0 else found
            continue
        parent: Any = found
        for part in path[:-1]:
            parent = parent[part]
        how = draw(st.sampled_from(["replace", "replace", "replace", "remove", "add", "double"]))
        if how == "remove":
            del parent[path[-1]]
        elif how == "add" and isinstance(parent, dict):
            parent[draw(TEXTS)] = draw(VALUES)
        elif how == "double" and isinstance(parent, list):
            parent.append(copy.deepcopy(parent[path[-1]]))
        else:
            parent[path[-1]] = draw(VALUES)
    return found


@contextlib.contextmanager
def one_line() -> Iterator[None]:
    """What the block raises is the user's mistake, said in one line that is not long."""
    try:
        yield
    except UserError as error:
        line = str(error)
        assert "\n" not in line and len(line) < 3000, line
        line.encode()


def written(value: Any) -> bytes:
    """JSON, also what JSON has no words for."""
    return json.dumps(value).encode("utf-8", "surrogatepass")


# --- The fuzzers ------------------------------------------------------------------------------

PARTS = ["first", "third_a", "=", "@", "-", ":", ",", ".", "0", "1", "20", "0.5", "patch", "noise"]
PARTS += ["off", "black", "delay", "strength=", "size=", "x=", " ", "\n", "é", "²", "٣", "9" * 30]
FAILURES = st.one_of(st.lists(st.sampled_from(PARTS), min_size=1, max_size=9).map("".join), TEXTS)


def occlusion(word: str) -> None:
    with one_line():
        failure = parse_failure(word)
        begin = failure.begin or None
        again = parse_failure(failure_text(failure.camera, failure.occlusion, begin))
        assert again.camera == failure.camera and again.begin == failure.begin
        planned = parse_schedule([word], [failure.camera])
        assert parse_schedule(schedule_words(planned), [failure.camera]) == planned


CAMERAS = {
    "camera": [
        {"name": "left", "position": [-0.7, 0.3, 0.6], "look_at": [0.0, 0.7, 0.1], "fovy": 55},
        {"name": "hand", "position": [0, 0, 1.0], "wxyz": [1, 0, 0, 0], "body": "hand", "size": 84},
        {"name": "far", "position": [0, 0, 2.0], "wxyz": [1, 0, 0, 0], "depth_range": [0.3, 1.8]},
    ]
}


def toml(value: Any) -> str:
    """A value as TOML has it, and JSON's word for what it does not have."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(
        json.dumps(value), json.dumps(value)
    )


def camera_file(document: Any, folder: Path) -> None:
    pairs = document.items() if isinstance(document, dict) else [("camera", document)]
    text = "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in pairs)
    file = folder / "cameras.toml"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    with one_line():
        for camera in read_cameras(file):
            assert 0 < camera.fovy < 180 and camera.size > 0


def kept_session(document: Any) -> None:
    with one_line():
        saved = parse(written(document), "saved.json")
        assert parse(saved.to_json().encode(), "again.json") == saved


@cache
def sound_policy(name: str) -> Any:
    return json.loads((CHECKPOINTS / "metaworld-hammer-mad-light" / name).read_text())


def short_evaluation() -> Any:
    """Ten thousand episodes would be changed nearly always; the keys are what matters."""
    found = copy.deepcopy(sound_policy("evaluation.json"))
    found["episodes"] = found["episodes"][:3]
    return found


def policy_folder(both: tuple[Any, Any], folder: Path) -> None:
    path = folder / "policies" / "fuzzed"
    path.mkdir(parents=True, exist_ok=True)
    (path / "config.json").write_bytes(written(both[0]))
    (path / "evaluation.json").write_bytes(written(both[1]))
    (path / "weights.safetensors").write_bytes(b"not read here")
    with one_line():
        describe(path)
    with one_line():
        shipped_evaluation(path)
    listed, broken = list_policies()
    assert len(listed) + len(broken) >= 1
    for each in broken:
        assert "\n" not in each["error"]
    catalogue(run_list(ListConfig())).encode()
    shutil.rmtree(path)


COMMANDS = {name: load(command.config) for name, command in cli.COMMANDS.items()}
COMMANDS |= {f"benchmarks {n}": load(command.config) for n, command in BENCHMARKS.items()}


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command, and options of it or of another one with any value at all."""
    name = draw(st.sampled_from(sorted(COMMANDS)))
    words = name.split()
    for _ in range(draw(st.integers(0, 4))):
        other = draw(st.sampled_from([name, name, name, *sorted(COMMANDS)]))
        known = [f"--{option.lstrip('-')}" for option, *_ in options(COMMANDS[other])]
        word = draw(st.one_of(st.sampled_from(known), TEXTS))
        value = draw(st.one_of(NUMBERS.map(str), TEXTS, st.sampled_from(["all", "mad", "None"])))
        words += draw(st.sampled_from([[word, value], [f"{word}={value}"], [word]]))
    return words


def every_option(words: list[str]) -> None:
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            code = benchmark(words[1:]) if words[0] == "benchmarks" else cli.main(words)
        except SystemExit as ended:
            code = ended.code
    assert code in (0, 1, 2), words
    assert "Traceback" not in said.getvalue(), words


MESSAGES = st.lists(
    st.tuples(
        st.sampled_from([*sorted(TAKEN), *["GuiUpdateMessage"] * 6]),
        st.dictionaries(st.sampled_from(["wxyz", "position", "fov", "name", "look_at"]), VALUES),
        VALUES,
        st.integers(0, 200),
    ),
    min_size=1,
    max_size=12,
)


class Hostile:
    """A page, a visitor who sends anything, and one who only watches that the page goes on."""

    def __init__(self, app: App) -> None:
        self.app, self.other, self._visitor = app, Visitor(app.url), None

    def visitor(self) -> Visitor:
        if self._visitor is None or self._visitor.ended:
            self._visitor = Visitor(self.app.url)
            seen = self._visitor
            until(lambda: len(seen.controls) > 20 or seen.ended)
        return self._visitor

    def sends(self, messages: Any) -> None:
        visitor = self.visitor()
        uuids = sorted(visitor.controls) or ["none"]
        for kind, odd, value, place in messages:
            names = wire_field_names(KINDS[kind])
            fields = {name: sample_of(kind, name) for name in names}
            fields |= {name: inner for name, inner in odd.items() if name in names}
            if kind == "GuiUpdateMessage":
                fields = {"uuid": uuids[place % len(uuids)], "updates": {"value": value}}
            with contextlib.suppress(OverflowError, UnicodeEncodeError):  # msgpack has no such.
                visitor.send_raw(msgspec.msgpack.encode({**fields, "type": kind}))
        seen = len(self.other.steps)
        until(lambda: len(self.other.steps) > seen or self.other.ended)
        assert not self.other.ended


@cache
def sample_of(kind: str, name: str) -> Any:
    from viser.infra._messages import get_type_hints_cached

    return sample(get_type_hints_cached(KINDS[kind])[name])


# --- Few of them every time, many now and then --------------------------------------------------


def tried(strategy: st.SearchStrategy, check: Callable[[Any], None], most: int) -> None:
    """Gives ``check`` up to ``most`` inputs. Few of them are the same every time."""
    chosen = settings(
        max_examples=most,
        deadline=None,
        derandomize=most <= FAST,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),  # type: ignore[arg-type]
    )

    @chosen
    @given(strategy)
    def property_(value: Any) -> None:
        check(value)

    property_()


few_and_many = pytest.mark.parametrize(
    "most", [pytest.param(FAST, id="few"), pytest.param(LONG, id="many", marks=pytest.mark.slow)]
)


@few_and_many
def test_the_grammar_of_occlusions(most: int) -> None:
    tried(FAILURES, occlusion, most)


@few_and_many
def test_camera_files(most: int, tmp_path: Path) -> None:
    tried(changed(lambda: CAMERAS), lambda found: camera_file(found, tmp_path), most)


@few_and_many
def test_kept_sessions(most: int) -> None:
    document()  # Whoever plays it draws numbers, and strategies shall not.
    tried(changed(document), kept_session, most)


@few_and_many
def test_policy_folders(most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checkpoint, "policy_roots", lambda: [tmp_path / "policies"])
    configs = changed(lambda: sound_policy("config.json"))
    strategy = st.tuples(configs, changed(short_evaluation))
    tried(strategy, lambda both: policy_folder(both, tmp_path), min(most, 3000))


@few_and_many
def test_every_option(most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "deliver", lambda *_: defaultdict(bool))
    tried(command_lines(), every_option, min(most, 3000))


@few_and_many
def test_websocket_messages(
    most: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connection, "PACE", 10_000)
    warned: list[str] = []
    monkeypatch.setattr("warnings.showwarning", lambda text, *_: warned.append(str(text)))
    app = fake_app("toy-mad", "toy-other", limits=Limits(visitors=2, watchers=9), speed=20.0)
    try:
        with caplog.at_level(logging.WARNING):
            hostile = Hostile(app)
            until(lambda: hostile.other.steps)
            tried(MESSAGES, hostile.sends, min(most // 5, 2000))
        ours = [str(r.exc_info) for r in caplog.records if r.exc_info]
        assert (ours, [text for text in warned if "[viser]" in text]) == ([], [])
    finally:
        app.stop()
