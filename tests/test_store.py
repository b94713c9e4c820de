"""The cache of results: what it keeps, what it keeps apart, and how it takes a beating."""

import os
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing
from dataclasses import replace

import pytest

from madviz.measure.store import MEMORY, EpisodeResult, ResultKey, Store
from tests.disks import room_for

KEY = ResultKey("d1", "toy/reach", "at the last step", "fast", "", "all")


def episode(seed=5000, subset="all", success=True):
    return EpisodeResult(subset, seed, success, True, 0.1 + seed / 3)


@pytest.fixture
def store(tmp_path):
    with_file = Store(tmp_path / "deep" / "results.sqlite")
    yield with_file
    with_file.close()


def test_results_come_back_to_the_bit_in_the_order_of_seeds(store):
    for seed in (5002, 5000, 5001):
        store.put(KEY, episode(seed))
    assert list(store.results(KEY).values()) == [episode(s) for s in (5000, 5001, 5002)]


@pytest.mark.parametrize(
    "field", ["digest", "task", "definition", "render_profile", "occlusions", "subset"]
)
def test_every_part_of_the_key_keeps_results_apart(store, field):
    store.put(KEY, episode())
    assert store.results(replace(KEY, **{field: "other"})) == {}


def test_results_outlive_the_store_and_are_seen_by_another_one(store):
    other = Store(store.path)
    store.put(KEY, episode())
    assert other.results(KEY) == {5000: episode()}
    other.close()


def test_same_episode_again_replaces(store):
    store.put(KEY, episode(success=False))
    store.put(KEY, episode(success=True))
    assert store.results(KEY) == {5000: episode(success=True)}


def test_a_policy_without_a_digest_is_never_stored(store):
    anonymous = replace(KEY, digest="")
    store.put(anonymous, episode())
    assert store.results(anonymous) == {}


def test_memory_store_needs_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = Store(MEMORY)
    store.put(KEY, episode())
    assert store.results(KEY) and not list(tmp_path.iterdir())


def test_default_path_follows_xdg(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert Store().path == str(tmp_path / "madviz" / "results.sqlite")


@pytest.mark.parametrize(
    "content", [b"not a database at all" * 100, b"SQLite format 3\0" + b"x" * 5000]
)
def test_a_corrupt_file_is_moved_aside_with_a_warning(tmp_path, content):
    path = tmp_path / "results.sqlite"
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="moved to .*broken"):
        store = Store(path)
    store.put(KEY, episode())
    assert store.results(KEY) == {5000: episode()}
    (aside,) = tmp_path.glob("*.broken-*")
    assert aside.read_bytes() == content
    store.close()


def test_a_file_that_breaks_while_open_is_replaced(tmp_path):
    path = tmp_path / "results.sqlite"
    store, other = Store(path), Store(path)
    for seed in range(300):
        other.put(KEY, episode(seed))
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    path.write_bytes(b"\xff" * path.stat().st_size)
    with pytest.warns(UserWarning, match="starting anew"):
        store.put(KEY, episode(7))
    assert store.results(KEY) == {7: episode(7)}
    store.close()
    other.close()


def test_a_folder_that_cannot_be_written_means_memory_only(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(UserWarning, match="memory only"):
        store = Store(tmp_path / "file" / "results.sqlite")
    store.put(KEY, episode())
    assert store.results(KEY) == {5000: episode()}


def test_a_link_to_a_corrupt_file_stays_a_link(tmp_path):
    (tmp_path / "far").mkdir()
    link, far = tmp_path / "results.sqlite", tmp_path / "far" / "results.sqlite"
    link.symlink_to(far)
    far.write_bytes(b"not a database at all" * 100)
    with pytest.warns(UserWarning, match="moved to .*broken"):
        store = Store(link)
    store.put(KEY, episode())
    assert link.is_symlink() and len(list(far.parent.glob("*.broken-*"))) == 1
    store.close()
    assert Store(far).results(KEY) == {5000: episode()}


def test_what_is_no_file_is_left_alone(tmp_path):
    path = tmp_path / "results.sqlite"
    os.mkfifo(path)
    with pytest.warns(UserWarning, match="found a device, a pipe or a folder; .*memory only"):
        store = Store(path)
    store.put(KEY, episode())
    assert store.results(KEY) == {5000: episode()} and list(tmp_path.iterdir()) == [path]


def test_many_threads_write_at_once(store):
    def write(first):
        for seed in range(first, first + 25):
            store.put(KEY, episode(seed))

    threads = [threading.Thread(target=write, args=(25 * i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.results(KEY) == {seed: episode(seed) for seed in range(200)}


def test_many_processes_write_at_once(store):
    code = (
        "import sys; from madviz.measure.store import *\n"
        "store, first = Store(sys.argv[1]), int(sys.argv[2])\n"
        "key = ResultKey('d1', 'toy/reach', 'at the last step', 'fast', '', 'all')\n"
        "for seed in range(first, first + 50):\n"
        "    store.put(key, EpisodeResult('all', seed, True, True, 0.1 + seed / 3))\n"
    )
    children = [
        subprocess.Popen([sys.executable, "-c", code, store.path, str(50 * i)]) for i in range(3)
    ]
    assert [child.wait(60) for child in children] == [0, 0, 0]
    assert store.results(KEY) == {seed: episode(seed) for seed in range(150)}


def test_on_a_full_disk_it_goes_on_in_memory_and_says_so(store):
    store.put(KEY, episode(1))
    assert store.trouble == ""
    path = store.path
    with room_for(), pytest.warns(UserWarning, match="results stay in memory only"):
        store.put(KEY, episode(2))
    assert store.trouble.startswith(path) and "memory only" in store.trouble
    store.put(KEY, episode(3))
    assert list(store.results(KEY)) == [1, 2, 3]
    with closing(Store(path)) as again:
        assert list(again.results(KEY)) == [1] and again.trouble == ""
