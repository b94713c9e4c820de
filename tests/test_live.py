"""The live evaluator: who is served next, what is stored, and what happens when processes die.

Jobs of the fake workers wait until a test says how they end, so nothing here depends on time; one
test at the end uses real processes.
"""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import pytest

from madviz.app.panels.success import bars_html
from madviz.app.success_rates import SuccessRates
from madviz.errors import UserError
from madviz.measure.episodes import Job, Runner
from madviz.measure.live import Evaluator
from madviz.measure.store import MEMORY, EpisodeResult, Store
from madviz.measure.workers import Workers
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.policies import checkpoint
from madviz.session.commands import SetCamera
from tests.checkpoints import make_config
from tests.disks import room_for
from tests.fakes import FakePolicy
from tests.sessions import frame_with

POLICY = "tests.fakes:FakePolicy"
ALL, FIRST, NONE = map(Condition, ("all", "first", "none"))


class FakeWorkers(Workers):
    """Takes jobs and does nothing; ``finish`` and ``fail`` end the oldest one."""

    def __init__(self, count: int, niceness: int = 0) -> None:
        super().__init__(count, niceness)
        self.waiting: list = []
        self.closed = False

    def submit(self, job):
        self.waiting.append((job, Future()))
        return self.waiting[-1][1]

    @property
    def jobs(self):
        return [(job.condition.subset, job.seed) for job, _ in self.waiting]

    def finish(self, success=True):
        job, future = self.waiting.pop(0)
        result = EpisodeResult(job.condition.subset, job.seed, success, True, 1.0)
        future.set_result((result, "at the last step: near"))
        return job

    def fail(self, error):
        self.waiting.pop(0)[1].set_exception(error)

    def close(self):
        self.closed = True


def fake(count, store=None, listener=None, episodes=4):
    """An evaluator and the fake workers inside it."""
    made: list[FakeWorkers] = []

    def make(count, niceness):
        made.append(FakeWorkers(count, niceness))
        return made[0]

    return Evaluator(count, store, listener, episodes, make), made[0]


@pytest.fixture
def live():
    return fake(1)


def test_seeds_are_run_in_order_one_at_a_time_until_there_are_enough(live):
    evaluator, workers = live
    assert evaluator.request("ann", POLICY, ALL).results == ()
    for seed in (60000, 60001, 60002, 60003):
        assert workers.jobs == [("all", seed)]
        workers.finish(success=seed > 60000)
    assert workers.jobs == []
    tally = evaluator.request("ann", POLICY, ALL)
    assert [result.success for result in tally.results] == [False, True, True, True]
    assert all(result.success_any for result in tally.results)
    assert [result.seed for result in tally.results] == [60000, 60001, 60002, 60003]


def test_asking_the_same_again_changes_nothing(live):
    evaluator, workers = live
    for _ in range(5):
        evaluator.request("ann", POLICY, ALL)
    assert workers.jobs == [("all", 60000)]


def test_a_changed_setting_is_next_and_the_old_one_is_resumed_later(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    evaluator.request("ann", POLICY, NONE)
    evaluator.request("ann", POLICY, FIRST)
    assert workers.jobs == [("all", 60000)]  # One episode of the past at most.
    workers.finish()
    assert workers.jobs == [("first", 60000)]
    workers.finish()
    evaluator.request("ann", POLICY, ALL)
    workers.finish()
    assert workers.jobs == [("all", 60001)]
    assert len(evaluator.request("ann", POLICY, ALL).results) == 1
    assert len(evaluator.request("ann", POLICY, FIRST).results) == 2


def test_visitors_take_turns_and_share_what_they_both_want(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    evaluator.request("bob", POLICY, FIRST)
    order = []
    for _ in range(6):
        order += workers.jobs
        workers.finish()
    assert order == [
        (subset, seed) for seed in (60000, 60001, 60002) for subset in ("all", "first")
    ]
    evaluator.request("bob", POLICY, ALL)
    assert len(evaluator.request("bob", POLICY, ALL).results) == 3
    assert workers.jobs == [("all", 60003)]


def test_several_workers_get_different_episodes():
    evaluator, workers = fake(3, episodes=5)
    evaluator.request("ann", POLICY, ALL)
    evaluator.request("bob", POLICY, ALL)
    assert workers.jobs == [("all", 60000), ("all", 60001), ("all", 60002)]
    workers.waiting.append(workers.waiting.pop(0))  # The first one takes longest.
    workers.finish()
    assert workers.jobs == [("all", 60002), ("all", 60000), ("all", 60003)]


def test_an_episode_counts_when_all_before_it_are_done():
    evaluator, workers = fake(3)
    evaluator.request("ann", POLICY, ALL)
    workers.waiting.append(workers.waiting.pop(0))  # The first one takes longest.
    workers.finish()
    workers.finish()
    assert workers.jobs == [("all", 60000), ("all", 60003)]
    assert evaluator.request("ann", POLICY, ALL).results == ()
    workers.finish()
    counted = [result.seed for result in evaluator.request("ann", POLICY, ALL).results]
    assert counted == [60000, 60001, 60002]


def test_a_visitor_who_left_is_not_served(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    evaluator.forget("ann")
    evaluator.forget("nobody")
    workers.finish()
    assert workers.jobs == []
    assert len(evaluator.request("bob", POLICY, ALL).results) == 1


def test_occlusions_that_cannot_be_noticed_are_the_same_setting(live):
    evaluator, _ = live
    black = (("third_a", Occlusion("black")),)
    for subset, same in ((FIRST, True), (ALL, False)):
        occluded = evaluator.request("ann", POLICY, Condition(subset.subset, black)).request
        assert (occluded == evaluator.request("ann", POLICY, subset).request) is same


def test_the_listener_hears_every_result():
    heard = []
    evaluator, workers = fake(1, listener=heard.append, episodes=2)
    evaluator.request("ann", POLICY, ALL)
    workers.finish()
    workers.finish()
    assert [(tally.request.condition.subset, len(tally.results)) for tally in heard] == [
        ("all", 1),
        ("all", 2),
    ]


def test_an_error_ends_its_setting_only_and_asking_anew_tries_again(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    evaluator.request("bob", POLICY, FIRST)
    workers.fail(UserError("cannot act on 'all'"))
    assert evaluator.request("ann", POLICY, ALL).error == "cannot act on 'all'"
    assert workers.jobs == [("first", 60000)]
    workers.finish()
    assert workers.jobs == [("first", 60001)]
    evaluator.request("ann", POLICY, ALL)
    assert workers.jobs == [("first", 60001)]  # Nothing was asked anew.
    evaluator.request("ann", POLICY, NONE)
    assert evaluator.request("ann", POLICY, ALL).error == ""
    workers.finish()
    assert workers.jobs == [("all", 60000)]


def test_after_a_killed_worker_the_same_seed_is_run_again(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    workers.finish()
    workers.fail(BrokenProcessPool("killed"))
    assert workers.generation == 1 and workers.jobs == [("all", 60001)]
    tally = evaluator.request("ann", POLICY, ALL)
    assert len(tally.results) == 1 and tally.error == ""


def test_it_gives_up_when_workers_keep_dying_and_starts_again_on_a_new_wish(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    for _ in range(3):
        workers.fail(BrokenProcessPool("killed"))
    assert workers.jobs == []
    assert evaluator.request("ann", POLICY, ALL).error.startswith("expected worker")
    evaluator.request("ann", POLICY, FIRST)
    assert workers.jobs == [("first", 60000)]


def test_unknown_policies_are_refused_and_the_wish_stays(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    with pytest.raises(UserError, match="unknown policy 'nope'"):
        evaluator.request("ann", "nope", FIRST)
    workers.finish()
    assert workers.jobs == [("all", 60001)]


def test_nothing_starts_after_close(live):
    evaluator, workers = live
    evaluator.request("ann", POLICY, ALL)
    evaluator.close()
    assert workers.closed
    workers.finish()
    evaluator.request("ann", POLICY, FIRST)
    assert workers.jobs == []


def test_results_of_policy_folders_go_into_the_store(monkeypatch, tmp_path):
    monkeypatch.setattr(checkpoint, "is_folder", lambda policy: True)
    spec = FakePolicy().spec
    config = make_config(definition="at the last step: near")
    folder = checkpoint.PolicyFolder(tmp_path, config, spec)
    monkeypatch.setattr(checkpoint, "describe", lambda policy: folder)
    store = Store(MEMORY)
    first, workers = fake(1, store)
    first.request("ann", "toy", ALL)
    workers.finish()
    workers.finish(success=False)
    later, workers = fake(1, store)
    tally = later.request("bob", "toy", ALL)
    assert [result.success for result in tally.results] == [True, False]
    assert workers.jobs == [("all", 60002)]
    assert later.request("bob", "toy", FIRST).results == ()


def test_real_workers_survive_a_kill_and_give_the_right_numbers():
    enough, some = threading.Event(), threading.Event()

    def listen(tally):
        some.set()
        if len(tally.results) == 60:
            enough.set()

    before = set(multiprocessing.active_children())
    evaluator = Evaluator(1, listener=listen, episodes=60)
    evaluator.request("ann", POLICY, ALL)
    assert some.wait(300)
    (victim,) = set(multiprocessing.active_children()) - before
    assert victim.pid is not None
    os.kill(victim.pid, signal.SIGKILL)
    assert enough.wait(300)
    runner, tally = Runner(), evaluator.request("ann", POLICY, ALL)
    assert tally.results == tuple(runner.run(Job(*tally.request, r.seed))[0] for r in tally.results)
    assert [r.seed for r in tally.results] == list(range(60000, 60060))
    evaluator.close()


def test_closing_does_not_wait_for_the_end_of_an_episode():
    started = threading.Event()
    evaluator = Evaluator(1, listener=lambda tally: started.set(), episodes=10**4)
    evaluator.request("bob", POLICY, FIRST)
    evaluator.request("ann", "tests.test_live:Patient", FIRST)
    assert started.wait(300)  # Bob's first episode is over, Ann's has begun.
    closing = time.monotonic()
    evaluator.close()
    assert time.monotonic() - closing < 10
    assert evaluator.request("ann", "tests.test_live:Patient", FIRST).results == ()


class Patient(FakePolicy):
    """Thinks for a second: an episode takes 25."""

    def read(self, encoded, masks):
        time.sleep(1)
        return super().read(encoded, masks)


def test_a_moved_camera_is_measured_where_it_stands_and_counts_apart(live):
    evaluator, workers = live
    right, up = Displacement(right=0.1), Displacement(up=0.1)
    there = Condition("first", (), (("first", right), ("third_b", up)))
    evaluator.request("ann", POLICY, there)
    job = workers.finish()
    assert job.condition.moves == (("first", right),)  # The other one is dropped: nobody would see.
    assert evaluator.request("ann", POLICY, FIRST).results == ()
    assert len(evaluator.request("ann", POLICY, there).results) == 1


def test_what_workers_measure_of_a_moved_camera_is_where_the_page_looks_for_it():
    made = []

    def make(listener):
        evaluator, workers = fake(1, listener=listener)
        made.append(workers)
        return evaluator

    policy = FakePolicy()
    rates = SuccessRates(make_evaluator=make, reference=lambda spec: POLICY)
    moved = Condition.of(Ablation({}, {"first": Displacement(pan=5)}), policy.spec.streams)
    rates.want("ann", policy.spec, moved)
    made[0].finish()
    assert rates.live(policy.spec, moved).n == 1
    assert rates.live(policy.spec, ALL).n == 0


def test_a_policy_that_is_no_folder_is_not_loaded_where_the_page_is_drawn(monkeypatch, live):
    evaluator, workers = live
    spec = FakePolicy().spec

    def loaded(reference):
        raise AssertionError(f"{reference} was loaded")

    monkeypatch.setattr(checkpoint, "load_policy", loaded)
    assert evaluator.request("ann", "guard:metaworld-hammer-mad-light", ALL, spec).results == ()
    assert workers.jobs == [("all", 60000)]
    with pytest.raises(AssertionError, match="was loaded"):
        evaluator.request("ann", "module:factory", ALL)


def test_a_folder_that_was_trained_again_meanwhile_is_not_measured_as_the_old_one(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(checkpoint, "is_folder", lambda policy: True)
    folder = checkpoint.PolicyFolder(tmp_path, make_config(), FakePolicy().spec)
    monkeypatch.setattr(checkpoint, "describe", lambda policy: folder)
    made = []

    def make(listener):
        evaluator, workers = fake(1, listener=listener)
        made.append(workers)
        return evaluator

    rates, frame = SuccessRates(make_evaluator=make), frame_with()
    acting = frame.world.policy
    rates.want("ann", acting, ALL)
    folder = replace(folder, spec=replace(acting, digest="trained again"))
    rates.want("ann", acting, FIRST)
    made[0].finish()  # It began with the old weights.
    assert made[0].jobs == [], "nothing more is played"
    assert rates.live(acting, Condition("all")).n == 1
    assert rates.live(folder.spec, Condition("all")).n == 0
    alone = frame_with(*(SetCamera(c, CameraState("off")) for c in ("third_a", "third_b")))
    said = "not measured: expected the weights that act here, found others in toy-mad"
    assert said in bars_html(alone, rates)
    rates.add(acting, Condition("first"), {2000: True})
    assert said in bars_html(alone, rates), "an episode of the page does not take it away"
    rates.want("bob", folder.spec, ALL)
    made[0].finish()
    assert rates.live(folder.spec, Condition("all")).n == 1
    assert rates.live(acting, Condition("all")).n == 1


def test_measuring_goes_on_when_the_disk_is_full_and_the_page_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(checkpoint, "is_folder", lambda policy: True)
    folder = checkpoint.PolicyFolder(tmp_path, make_config(), FakePolicy().spec)
    monkeypatch.setattr(checkpoint, "describe", lambda policy: folder)
    store, heard = Store(tmp_path / "results.sqlite"), []
    evaluator, workers = fake(1, store, heard.append)
    rates = SuccessRates(make_evaluator=lambda listener: evaluator)
    frame = frame_with()
    evaluator.request("ann", "toy", ALL)
    assert "not stored" not in bars_html(frame, rates)
    with room_for(), pytest.warns(UserWarning, match="memory only"):
        workers.finish()
    workers.finish()
    assert len(heard[-1].results) == 2 and not heard[-1].error and workers.jobs == [("all", 60002)]
    assert "not stored: " in bars_html(frame, rates) and "memory only" in bars_html(frame, rates)


def test_measuring_that_cannot_be_recorded_ends_with_a_word(monkeypatch, tmp_path):
    monkeypatch.setattr(checkpoint, "is_folder", lambda policy: True)
    folder = checkpoint.PolicyFolder(tmp_path, make_config(), FakePolicy().spec)
    monkeypatch.setattr(checkpoint, "describe", lambda policy: folder)
    store, heard = Store(MEMORY), []
    evaluator, workers = fake(1, store, heard.append)
    evaluator.request("ann", "toy", ALL)
    store.close()
    workers.finish()
    assert len(heard[-1].results) == 1 and "closed database" in heard[-1].error
