"""Sessions that are kept for those whose connection was cut."""

from __future__ import annotations

import json

from websockets.datastructures import Headers
from websockets.http11 import Request

from madviz.app.kept import KEEPS, MOST_KEPT, KeptSessions
from madviz.envs.registry import make_env
from madviz.session.session import Session
from tests.fakes import FakePolicy
from tests.sessions import Recorder


def answer(kept: KeptSessions, path: str) -> tuple[int, bytes] | None:
    found = kept.answer(Request(path, Headers()))
    return None if found is None else (found.status_code, bytes(found.body or b""))


def test_a_session_is_there_for_its_own_visit_and_for_a_while() -> None:
    now = [0.0]
    kept = KeptSessions(lambda: now[0])
    session = Recorder()
    session.steps(3)
    kept.keep("mine", session)
    found = answer(kept, "/madviz-session?visit=mine")
    assert found is not None and found[0] == 200
    assert json.loads(found[1])["episodes"][-1]["steps"] == 3
    for other in ("/madviz-session?visit=yours", "/madviz-session"):
        assert (answer(kept, other) or (0,))[0] == 404
    assert answer(kept, "/index.html") is None
    now[0] = KEEPS + 1
    assert (answer(kept, "/madviz-session?visit=mine") or (0,))[0] == 404


def test_there_are_not_more_than_a_few_and_nothing_of_an_empty_session() -> None:
    kept = KeptSessions()
    session = Recorder()
    session.steps(1)
    for number in range(MOST_KEPT + 1):
        kept.keep(str(number), session)
    assert kept.of("0") is None and kept.of("1") is not None
    kept.keep("empty", Session(make_env, FakePolicy()))
    assert kept.of("empty") is None
