"""Visitors come and go; what is left of them is counted."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from benchmarks.live import LiveConfig, watched
from benchmarks.soak import (
    Crowd,
    Sample,
    SoakConfig,
    judged,
    rounds,
    sample,
    settled,
    soak,
    soak_words,
)
from benchmarks.visitor import Visitor
from madviz.app.users import Limits
from madviz.errors import UserError
from tests.pages import await_that, fake_app, seats, sessions_shown


def samples(memory, threads=None, processes=None) -> list[Sample]:
    count = len(memory)
    return [
        Sample(*one)
        for one in zip(memory, threads or [20] * count, processes or [1] * count, strict=True)
    ]


def test_growth_during_warm_up_is_no_leak():
    result = judged(samples([300, 400, 450, 460, 461, 459, 462, 460, 461]), 3.0)
    assert result["kept"]
    assert result["memory_mb"]["after_warm_up"] == 460.5 and result["memory_mb"]["end"] == 460.5


@pytest.mark.parametrize(("rounds", "minutes", "warm_up"), [(100, 50.0, 10), (9, 4.5, 3)])
def test_growth_an_hour_is_counted_from_third_to_third(rounds, minutes, warm_up):
    # A MB more in each round, two rounds a minute.
    result = judged(samples([460 + n for n in range(rounds)]), minutes)
    assert result["memory_mb"]["growth_an_hour"] == 120 and result["warm_up"] == warm_up


def test_growth_after_warm_up_is_a_leak():
    assert not judged(samples([460 + 5 * n for n in range(9)]), 3.0)["kept"]
    assert not judged(samples([460] * 9, threads=[20 + 2 * n for n in range(9)]), 3.0)["kept"]
    assert not judged(samples([460] * 9, processes=[1, 1, 1, 1, 1, 1, 1, 2, 2]), 3.0)["kept"]
    # One straggler at the very end is no leak, a child that stays is.
    assert judged(samples([460] * 9, threads=[20] * 8 + [40]), 3.0)["kept"]


STAYS, DIES = "import time; time.sleep(60)", "import sys; sys.exit('Traceback: the reason')"


@pytest.fixture
def server(monkeypatch):
    """Makes ``soak`` start a program in the server's place."""

    def replace(program: str, crowd: Callable[[Crowd], Iterator[Sample]] | None = None) -> None:
        @contextmanager
        def serving(words, log):
            process = subprocess.Popen([sys.executable, "-c", program], stderr=log)
            if program == DIES:
                process.wait()
            try:
                yield "http://127.0.0.1:9", process
            finally:
                process.kill()
                process.wait()

        monkeypatch.setattr("benchmarks.soak.serving", serving)
        if crowd is not None:
            monkeypatch.setattr("benchmarks.soak.rounds", lambda here, *_: crowd(here))

    return replace


def test_a_server_that_dies_early_says_why(server):
    server(DIES)
    with pytest.raises(UserError, match="(?s)expected 9 rounds, found 0.*Traceback: the reason"):
        soak(SoakConfig(minutes=0.1))


def test_what_was_measured_before_a_server_died_is_kept(server):
    def crowd(here: Crowd) -> Iterator[Sample]:
        here.visits, here.updates = 20, 400
        yield from samples([300] * 12)
        raise UserError("no page to visit")

    server(DIES, crowd)
    result = soak(SoakConfig(minutes=5.0))
    assert result["rounds"] == 12 and result["kept"] and result["served"] and not result["ok"]
    assert result["errors"] == [
        "Traceback: the reason", "no page to visit", "the server ended by itself"
    ]  # fmt: skip
    assert "the server has not grown" in soak_words(result)
    assert result["minutes"] < 1, "it ran for less than the five minutes asked"


def test_a_soak_whose_visitors_saw_nothing_has_not_passed(server):
    def crowd(here: Crowd) -> Iterator[Sample]:
        here.visits, here.updates = 20, 19
        yield from samples([300] * 12)

    server(STAYS, crowd)
    result = soak(SoakConfig(minutes=5.0))
    assert result["kept"] and result["errors"] == [] and not result["ok"]
    assert "TOO FEW PICTURES FOR A SOAK: 19 pictures came in 20 visits" in soak_words(result)


def test_rounds_are_as_long_as_asked_unless_the_time_is_too_short_for_nine():
    class Hurried:
        def __init__(self) -> None:
            self.lengths: list[float] = []

        def round(self, seconds: float) -> Sample:
            self.lengths.append(seconds)
            return Sample(300.0, 20, 1)

    for seconds, longest, length in ((0.09, 60.0, 0.01), (0.09, 0.005, 0.005)):
        crowd = Hurried()
        assert len(list(rounds(crowd, seconds, longest))) >= 9  # pyright: ignore[reportArgumentType]
        assert crowd.lengths == pytest.approx([length] * len(crowd.lengths))


def test_a_sample_counts_threads_and_memory():
    # In a process of its own: this one may put a block where an earlier test has freed one.
    grows = (
        "import threading\n"
        "print('before', flush=True), input()\n"
        "block = bytearray(b'x' * 50_000_000)\n"
        "threading.Thread(target=threading.Event().wait, daemon=True).start()\n"
        "print('after', flush=True), input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", grows], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == "before\n"
        before = sample(process.pid)
        print(file=process.stdin, flush=True)
        assert process.stdout.readline() == "after\n"
        after = sample(process.pid)
        print(file=process.stdin, flush=True)
    assert after.threads == before.threads + 1 and after.memory_mb > before.memory_mb + 30
    assert sample(2**22 + 1).memory_mb == 0.0


def test_settling_waits_for_a_thread_that_has_not_ended():
    calm = settled(os.getpid()).threads  # Threads of earlier tests may be ending.
    thread = threading.Timer(2.5, lambda: None)
    thread.start()
    assert settled(os.getpid()).threads == calm + 1  # Nothing is known of what there should be.
    assert settled(os.getpid(), calm, 0.1).threads == calm + 1  # It waits no longer than it may.
    assert settled(os.getpid(), calm).threads == calm and not thread.is_alive()


def ours() -> set[threading.Thread]:
    names = ("madviz", "visitor")
    return {one for one in threading.enumerate() if one.name.startswith(names)}


def test_visitors_leave_neither_threads_nor_processes():
    before = ours()  # What other tests have left is not this test's concern.
    app = fake_app("toy-mad", "toy-other", limits=Limits(visitors=2))
    crowd = Crowd(app.url, os.getpid(), most=3, seed=1)
    try:
        left = [crowd.round(4.0), crowd.round(4.0)]
        while crowd.touches <= 20 and len(left) < 10:  # A busy machine gets more rounds.
            left.append(crowd.round(4.0))
        deadline = time.monotonic() + 20
        while ours() - before and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not ours() - before
        assert crowd.visits >= 2 and crowd.touches > 20 and crowd.updates > 5
        assert left[-1].processes == left[0].processes
        assert seats(app.users) == (0, 0, 0)
    finally:
        app.stop()


def test_a_simulation_is_freed_as_soon_as_its_visitor_has_left():
    """The call that closes a page has a reference to it; it must be freed after that call."""
    app = fake_app("toy-mad", limits=Limits(visitors=2))
    try:
        with Visitor(app.url) as visitor:
            await_that(lambda: visitor.steps, 30.0)
            (number,) = app.server.get_clients()
            session = weakref.ref(sessions_shown(app.users)[number])
        await_that(lambda: session() is None, 30.0)
    finally:
        app.stop()


def test_a_visitor_touches_what_can_be_touched_now():
    app = fake_app("toy-mad")
    try:
        with Visitor(app.url) as visitor:
            await_that(lambda: visitor.steps, 30.0)
            rng = random.Random(0)
            assert visitor.toggle(rng)
            for uuid in list(visitor.controls):
                visitor._change(uuid, {"visible": False, "value": "other"})
            assert not visitor.toggle(rng)
            assert {one["value"] for one in visitor.controls.values() if "value" in one} == {
                "other"
            }
    finally:
        app.stop()


@pytest.mark.slow
def test_a_server_does_not_grow_in_three_minutes_of_visits():
    result = soak(SoakConfig(minutes=3.0, policy="tests.fakes:FakePolicy"))
    assert result["errors"] == []
    assert result["ok"], result


def test_updates_of_watchers_are_counted_by_visitors_without_browsers():
    result = watched(LiveConfig(policy="tests.fakes:FakePolicy", seconds=1.0, watchers=2))
    assert result["count"] == len(result["updates_per_s"]) == 2
    assert 0 < result["least"] <= min(result["updates_per_s"]) and result["owner"] > 0
