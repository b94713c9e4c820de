"""Commands on their way to a session: in order, without a thread between, and nobody waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from madviz.session.commands import Command, Pause, SetSeed
from madviz.session.inbox import Inbox, Outbox, PipeInbox


@contextmanager
def writing(box: Outbox) -> Iterator[Connection]:
    """The other end of ``box``, whose writer runs."""
    there, here = Pipe()
    writer = threading.Thread(target=box.write, args=(here,))
    writer.start()
    try:
        while box._pipe is None:
            time.sleep(0.001)
        yield there
    finally:
        there.close()
        box.put(None)
        writer.join(10)
        assert not writer.is_alive()


def test_a_command_is_in_the_pipe_when_put_returns():
    box = Outbox()
    with writing(box) as there:
        for seed in range(200):
            box.put(SetSeed(seed))
            assert there.poll(0)
            assert there.recv() == SetSeed(seed)


def test_what_a_process_has_no_time_for_waits_in_order_and_nobody_waits_for_it():
    box, many = Outbox(), 5000
    box.put(SetSeed(0))  # Before there is a process.
    with writing(box) as there:
        began = time.monotonic()
        for seed in range(1, many):
            box.put(SetSeed(seed))
        assert time.monotonic() - began < 5.0
        assert len(box) > 0
        for seed in range(many):  # Room, and more comes.
            box.put(SetSeed(many + seed))
            assert there.recv() == SetSeed(seed)
        for seed in range(many, 2 * many):
            assert there.recv() == SetSeed(seed)
        while len(box):
            time.sleep(0.001)
        box.put(Pause())
        assert there.poll(0)


def test_a_process_that_has_ended_takes_nothing_and_raises_nothing():
    box = Outbox()
    with writing(box) as there:
        there.close()
        box.put(Pause())


def test_an_inbox_hands_over_what_the_one_before_it_had():
    before = Inbox()
    before.put(SetSeed(1))
    before.put(Pause())
    here, _there = Pipe()
    inbox = PipeInbox(before, here, lambda what: None)
    assert [inbox.take(), inbox.take(), inbox.take()] == [SetSeed(1), Pause(), None]


def test_commands_of_both_ways_arrive_and_the_rest_goes_to_the_other():
    others: list[object] = []
    here, there = Pipe()
    inbox = PipeInbox(Inbox(), here, others.append)
    inbox.put(Pause())
    there.send("save")
    there.send(SetSeed(4))
    there.close()
    found: list[Command | None] = [inbox.take() for _ in range(4)]
    assert [one for one in found if one is not None] == [Pause(), SetSeed(4)]
    assert others == ["save", None]


def test_another_thread_wakes_whoever_waits():
    here, _there = Pipe()
    inbox = PipeInbox(Inbox(), here, lambda what: None)
    threading.Timer(0.05, inbox.put, [SetSeed(2)]).start()
    assert inbox.take(10.0) == SetSeed(2)
    threading.Timer(0.05, inbox.put, [None]).start()
    began = time.monotonic()
    assert inbox.take(10.0) is None and time.monotonic() - began < 5.0


def test_a_wake_hides_no_command_behind_it():
    box = Inbox()
    for what in (None, Pause(), None, None, SetSeed(3), None):
        box.put(what)
    assert [box.take(), box.take(), box.take(), box.take()] == [Pause(), SetSeed(3), None, None]
