"""The replay buffer against stacks that are made as an episode runs and kept in a list."""

from __future__ import annotations

import errno
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack, stream_frame
from madviz.runs import buffer as buffer_module
from madviz.runs import buffer_storage
from madviz.runs.buffer import BufferSpec, ReplayBuffer
from madviz.runs.buffer_device import DeviceFrames
from madviz.runs.buffer_storage import Pack, PlainFrames
from madviz.subsets import camera_of, cameras_of
from madviz.types import Array

STREAMS = ("first.rgb", "first.depth", "third_a.rgb")
SPEC = BufferSpec(STREAMS, state_dim=6, action_dim=2, capacity=40, horizon=5)
PACKED = replace(SPEC, packed=True)


@pytest.fixture(autouse=True)
def small_packs(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that episodes of six instants fill several."""
    monkeypatch.setattr(buffer_storage, "TOGETHER", 8)


class Recorded:
    """Plays toy episodes into a buffer and remembers every transition whole."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self.buffer = buffer
        self.views: list[Array] = []
        self.states: list[Array] = []
        self.steps: dict[int, tuple[Array, float]] = {}
        self._env = ToyReach()
        self._env.spec = replace(self._env.spec, horizon=buffer.spec.horizon)
        self._rng = np.random.default_rng(0)

    def play(self, episodes: int, first: int = 0) -> None:
        for seed in range(first, first + episodes):
            now = self._env.reset(seed)
            stack = StreamStack(self._env.spec, self.buffer.spec.streams, 3)
            self.buffer.begin(now.state, self._look(stack, seed, 0))
            self.states.append(now.state)
            for step in range(1, self.buffer.spec.horizon + 1):
                action = self._rng.uniform(-1, 1, 2).astype(np.float32)
                self.steps[len(self.views) - 1] = (action, float(step))
                now = self._env.step(action)
                frames = self._look(stack, seed, step)
                self.buffer.add(action, step, 0.9 * (not now.last), now.state, frames)
                self.states.append(now.state)

    def _look(self, stack: StreamStack, seed: int, step: int) -> list[Array]:
        streams = self.buffer.spec.streams
        views = {camera: self._env.view(camera) for camera in cameras_of(streams)}
        stack.push(views, Ablation(), seed, step)
        self.views.append(stack.views)
        return [stream_frame(views[camera_of(s)], s, self._env.spec) for s in streams]

    def check(self, index: Array) -> None:
        """The buffer's transitions at ``index`` are those that were seen."""
        batch = self.buffer.batch(index)
        for b, i in enumerate(index.tolist()):
            action, reward = self.steps[i]
            np.testing.assert_array_equal(batch.views[b], self.views[i])
            np.testing.assert_array_equal(batch.next_views[b], self.views[i + 1])
            np.testing.assert_array_equal(batch.state[b], self.states[i])
            np.testing.assert_array_equal(batch.next_state[b], self.states[i + 1])
            np.testing.assert_array_equal(batch.action[b], action)
            assert batch.reward[b] == reward
            assert batch.discount[b] == pytest.approx(0.0 if reward == 5 else 0.9)


def drawn(buffer: ReplayBuffer, size: int = 4000) -> list[int]:
    return sorted(set(buffer.draw(size, np.random.default_rng(1)).tolist()))


@pytest.mark.parametrize("spec", [SPEC, PACKED])
def test_samples_are_the_transitions_that_were_seen(spec: BufferSpec) -> None:
    recorded = Recorded(ReplayBuffer(spec))
    recorded.play(3)
    assert len(recorded.buffer) == 15
    assert drawn(recorded.buffer) == sorted(recorded.steps), "all of them, none across episodes"
    recorded.check(np.array(sorted(recorded.steps)))
    batch = recorded.buffer.sample(7, np.random.default_rng(0))
    assert batch.views.shape == (7, 3, 9, 84, 84) and batch.views.dtype == torch.uint8
    assert batch.views.flatten(0, 1).is_contiguous(memory_format=torch.channels_last)


def test_frames_on_a_device_show_what_frames_here_show() -> None:
    """PyTorch's memory of this machine stands in for a GPU's."""
    rng, rows = np.random.default_rng(0), 5
    here, there = PlainFrames(rows, (3, 1)), DeviceFrames(rows, (3, 1), "cpu")
    for number in range(8):
        frames = [rng.integers(0, 256, (84, 84, c), np.uint8) for c in (3, 1)]
        here.write(number, frames)
        there.write(number, frames)
    histories = [np.array([[3, 4, 5], [7, 7, 7]]), np.array([[4, 5, 6], [5, 6, 7]])]
    for expected, found in zip(here.stacks(histories), there.stacks(histories), strict=True):
        assert torch.equal(found, expected) and found.stride() == expected.stride()
    np.testing.assert_array_equal(there.read(1, [6, 3])[3], here.read(1, [3])[3])
    for store in (here, there):
        np.testing.assert_array_equal(store.read(0, [2])[2], store.read(0, [7])[7])  # In 5 rows.


@pytest.mark.parametrize("spec", [SPEC, PACKED])
def test_a_full_ring_forgets_the_oldest_and_keeps_its_capacity(spec: BufferSpec) -> None:
    recorded = Recorded(ReplayBuffer(spec))
    recorded.play(17)
    rows = SPEC.rows
    assert len(recorded.views) > 2 * rows - rows // 2, "it went round"
    kept = drawn(recorded.buffer)
    assert len(kept) == len(recorded.buffer) >= SPEC.capacity
    oldest = len(recorded.views) - rows
    whole = [i for i in recorded.steps if i - min(i % 6, 2) >= oldest]
    assert kept == whole, "neither lost rows nor stacks that reach into them"
    recorded.check(np.array(kept))


def test_a_draw_looks_at_what_it_draws_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the paper's capacity a look at all of them would take 10 ms of each update."""
    recorded = Recorded(ReplayBuffer(SPEC))
    recorded.play(17)
    looked_at: list[int] = []
    usable = ReplayBuffer._usable

    def look(buffer: ReplayBuffer, index: Array) -> Array:
        looked_at.append(len(index))
        return usable(buffer, index)

    monkeypatch.setattr(ReplayBuffer, "_usable", look)
    recorded.buffer.draw(5, np.random.default_rng(0))
    assert set(looked_at) == {5}


def test_a_running_episode_is_sampled_too() -> None:
    recorded = Recorded(ReplayBuffer(SPEC))
    recorded.play(1)
    with pytest.raises(ValueError, match="expected 1 transitions in a row"):
        ReplayBuffer(SPEC).sample(1, np.random.default_rng(0))
    buffer, frame = recorded.buffer, [np.zeros((84, 84, c), np.uint8) for c in SPEC.channels]
    buffer.begin(np.full(6, 7.0), frame)
    assert buffer.age == 0 and len(buffer) == 5 and len(buffer.actions()) == 0
    buffer.add(np.array([0.5, -0.5]), 1.0, 0.9, np.full(6, 8.0), frame)
    assert buffer.age == 1 and len(buffer) == 6
    np.testing.assert_array_equal(buffer.actions(), [[[0.5, -0.5]]])
    views, state = buffer.newest()
    assert views.shape == (1, 3, 9, 84, 84) and not views.any() and (state == 8).all()


def test_lanes_share_a_ring_and_never_mix() -> None:
    """Three environments in turn: each lane's samples are those of a buffer of its own."""
    lanes, horizon, episodes = 3, 5, 9
    spec = replace(PACKED, lanes=lanes, capacity=42, horizon=horizon)
    together = ReplayBuffer(spec)
    alone = [ReplayBuffer(replace(PACKED, capacity=200)) for _ in range(lanes)]
    rng = np.random.default_rng(0)
    for step in range(episodes * (horizon + 1)):
        for lane in range(lanes):
            state, action = rng.normal(size=6), rng.uniform(-1, 1, 2)
            frames = [rng.integers(0, 255, (84, 84, c), np.uint8) for c in spec.channels]
            for buffer in (together, alone[lane]):
                if step % (horizon + 1):
                    buffer.add(action, 10 * step + lane, 0.9, state, frames)
                else:
                    buffer.begin(state, frames)
    assert together.age == horizon and together.actions().shape == (horizon, lanes, 2)
    index = np.unique(together.draw(2000, np.random.default_rng(1)))
    assert 42 <= len(index) == len(together)
    batch = together.batch(index)
    for place, number in enumerate(index.tolist()):
        instant, lane = divmod(number, lanes)
        single = alone[lane].batch(np.array([instant]))
        for name in ("views", "next_views", "state", "action", "reward", "next_state"):
            assert torch.equal(getattr(batch, name)[place], getattr(single, name)[0]), name
    for lane, (views, state) in enumerate(zip(*together.newest(), strict=True)):
        assert torch.equal(views, alone[lane].newest()[0][0])
        assert torch.equal(state, alone[lane].newest()[1][0])


def test_a_pack_gives_back_every_frame_and_is_smaller() -> None:
    env = ToyReach()
    env.reset(0)
    frames = []
    for _ in range(20):
        env.step(env.expert())
        frames.append(env.view("third_a").rgb)
    frames[7] = np.random.default_rng(0).integers(0, 255, (84, 84, 3), np.uint8)
    stacked = np.stack(frames)
    pack = Pack.of(stacked)
    again = Pack.from_arrays(pack.arrays())
    for each in (pack, again):
        for place in (19, 0, 7, 7):
            np.testing.assert_array_equal(each.frames([place])[0], stacked[place])
    assert len(pack) == 20 and pack.nbytes < stacked.nbytes / 2


def test_memory_is_what_the_frames_packed_take(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffer_storage, "TOGETHER", 40)
    spec = replace(SPEC, capacity=200)
    _, plain = played(spec)
    buffer, packed = played(replace(spec, packed=True))
    assert plain > spec.rows * 84 * 84 * 7
    assert packed < plain / 2, "with 40 plain ones"
    assert buffer.packed_bytes_per_row < 84 * 84 * 7 / 3, "with 8 pictures for 40"


def played(spec: BufferSpec) -> tuple[ReplayBuffer, int]:
    """A buffer after 60 episodes, and the bytes that its frames take."""
    tracemalloc.start()
    try:
        recorded = Recorded(ReplayBuffer(spec))
        recorded.play(60)
        here = tracemalloc.Filter(True, buffer_storage.__file__)
        held = tracemalloc.take_snapshot().filter_traces([here]).statistics("filename")
    finally:
        tracemalloc.stop()
    return recorded.buffer, sum(each.size for each in held)


def test_frames_that_pack_badly_are_found_out_early(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = replace(PACKED, capacity=300_000)
    monkeypatch.setattr(buffer_module, "_free", lambda spec, folder, device: 8 * 10**9)
    buffer, rng = ReplayBuffer(spec), np.random.default_rng(0)

    def frames() -> list[Array]:
        return [rng.integers(0, 255, (84, 84, c), np.uint8) for c in spec.channels]

    buffer.begin(np.zeros(6), frames())
    with pytest.raises(UserError, match=r"needs \d\d.\d GB, found 8.0 GB free in memory"):
        for _ in range(8):
            buffer.add(np.zeros(2), 0.0, 0.9, np.zeros(6), frames())


def test_the_frames_of_an_earlier_start_make_room_for_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Recorded(ReplayBuffer(SPEC, tmp_path)).play(12)
    numbers = SPEC.rows * (SPEC.bytes_per_row - SPEC.frame_bytes)
    full = SimpleNamespace(f_bavail=numbers, f_frsize=1)
    monkeypatch.setattr(os, "statvfs", lambda folder: full)
    ReplayBuffer(SPEC, tmp_path)
    with pytest.raises(UserError, match="0.0 GB free in"):
        ReplayBuffer(SPEC, tmp_path / "elsewhere")


@pytest.mark.parametrize("again", [(False, False), (False, True), (True, False)])
@pytest.mark.parametrize("before", [(False, False), (False, True), (True, False)])
def test_frames_may_be_stored_otherwise_after_a_restart(
    before: tuple[bool, bool], again: tuple[bool, bool], tmp_path: Path
) -> None:
    def stored(packed: bool, on_disk: bool) -> ReplayBuffer:
        folder = tmp_path / "frames" if on_disk else None
        return ReplayBuffer(replace(SPEC, packed=packed), folder)

    first, second = Recorded(stored(*before)), Recorded(stored(*again))
    first.play(12)
    second.buffer.restore(tmp_path / "parts", first.buffer.save(tmp_path / "parts"))
    for name in ("views", "states", "steps"):
        setattr(second, name, getattr(first, name))
    second.play(2, first=12)
    second.check(np.array(drawn(second.buffer)))


@pytest.mark.parametrize(("packed", "on_disk"), [(False, False), (False, True), (True, False)])
def test_a_restored_buffer_goes_on_as_if_never_stopped(
    tmp_path: Path, packed: bool, on_disk: bool
) -> None:
    spec = replace(SPEC, packed=packed)
    recorded = Recorded(ReplayBuffer(spec))
    for episode in range(12):  # Saved in pieces, round the ring.
        recorded.play(1, first=episode)
        state = recorded.buffer.save(tmp_path)
    written = {file.name for file in tmp_path.iterdir()}
    assert set(state["parts"]) == written or set(state["parts"]) < written
    recorded.play(1, first=90)
    later = recorded.buffer.save(tmp_path)
    assert set(later["parts"]) - set(state["parts"])

    again = Recorded(ReplayBuffer(spec, tmp_path / "frames" if on_disk else None))
    again.buffer.restore(tmp_path, state)
    left = {file.name for file in tmp_path.glob("part*")}
    assert left == set(state["parts"]), "what was written after that state is gone"
    for name in ("views", "states", "steps"):
        setattr(again, name, getattr(recorded, name))
    again.views, again.states = again.views[:72], again.states[:72]
    again.steps = {i: s for i, s in again.steps.items() if i < 71}
    again.check(np.array(drawn(again.buffer)))
    again.play(2, first=12)
    again.check(np.array(drawn(again.buffer)))
    third = Recorded(ReplayBuffer(spec))
    third.buffer.restore(tmp_path, again.buffer.save(tmp_path))
    third.views, third.states, third.steps = again.views, again.states, again.steps
    assert drawn(third.buffer) == drawn(again.buffer)
    third.check(np.array(drawn(third.buffer)))


def test_the_room_on_a_disk_is_taken_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mapped file that meets a full disk later ends the process with a bus error."""
    PlainFrames(10, (3,), [tmp_path / "first.frames"])
    assert 512 * (tmp_path / "first.frames").stat().st_blocks >= 10 * 84 * 84 * 3

    def full(file: int, start: int, size: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left"):
        PlainFrames(10, (3,), [tmp_path / "first.frames"])


def test_a_small_buffer_still_holds_the_episode_that_is_running() -> None:
    """A resumed run repeats it, by all of its actions."""
    buffer = ReplayBuffer(replace(SPEC, capacity=8, horizon=20, lanes=2))
    frames = [np.zeros((84, 84, c), np.uint8) for c in SPEC.channels]
    for _ in range(2):  # Episodes; the second one is not over.
        for _ in range(2):
            buffer.begin(np.zeros(6), frames)
        for step in range(19):
            for lane in range(2):
                buffer.add(np.full(2, step + lane / 2), 0.0, 1.0, np.zeros(6), frames)
    expected = np.arange(19)[:, None] + [0, 0.5]  # (age, L)
    np.testing.assert_array_equal(buffer.actions()[..., 0], expected)


def test_the_memory_it_will_need_is_said_before() -> None:
    paper = BufferSpec(("first", "third_a", "third_b"), 24, 4, capacity=500_000, horizon=100)
    assert paper.rows == 505_003
    assert paper.rows * paper.bytes_per_row / 1e9 == pytest.approx(32.1, abs=0.05)
    with pytest.raises(UserError) as error:
        ReplayBuffer(paper, available=16 * 10**9)
    assert str(error.value) == (
        "the replay buffer of 500000 transitions of 3 streams needs 32.1 GB, found 16.0 GB free "
        "in memory; free some, or start a training with 248000 transitions or fewer, or with the "
        "buffer on disk"
    )
    ReplayBuffer(replace(paper, capacity=248_000), available=16 * 10**9)
    packed = replace(paper, packed=True)
    assert packed.rows * packed.bytes_per_row / 1e9 == pytest.approx(12.1, abs=0.05)


def test_a_disk_that_is_too_small_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"0.0 GB free in {tmp_path}"):
        ReplayBuffer(SPEC, tmp_path, available=1000)
