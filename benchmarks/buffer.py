"""``benchmarks buffer``: the replay buffer packed and plain, filled with the same real frames.

Both hold the same transitions and give the same batches, to the bit; that is checked. Compared are
the bytes of a transition and how long a batch takes to be put together, the two sides in turns:
``sample_ms`` by the clock, ``sample_cpu_ms`` of this thread, which others do not lengthen.
Memory for the paper's 500,000 transitions is then a multiplication. ``--fill`` makes a
packed buffer of that many transitions for real, by repeating the recorded episodes: a pack is made
from 1,024 time steps, and as long as more than that are recorded no pack gets one twice, so that
repeating changes nothing in its size. The process's memory before and after is measured then.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np

from benchmarks.memory import kilobytes
from madviz.envs.registry import TaskName, make_env
from madviz.errors import UserError
from madviz.runs.buffer import BufferSpec, ReplayBuffer
from madviz.runs.buffer_storage import TOGETHER
from madviz.system.numbers import Count, CountOrNone, Width
from madviz.types import Array, Environment

PAPER = 500_000
"""Transitions the paper remembers."""


@dataclass(frozen=True)
class BenchBufferConfig:
    """The recorded data and the timed operations."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    task: TaskName = "metaworld/hammer"
    """The task whose frames are stored; half of the episodes the expert's, half random."""
    decisions: Count = 1_200
    """Recorded, in whole episodes; more than the 1,024 time steps of a pack."""
    batch_size: Width = 256
    """Transitions in a timed batch."""
    rounds: Count = 15
    """Timed batches of each side; one more is not timed."""
    fill: CountOrNone = 0
    """Also fill a packed buffer with so many transitions and measure the process; 0 does not."""


@dataclass(frozen=True)
class RecordedStep:
    """One row for the buffer; ``action`` led to it, None at the start of an episode."""

    action: Array | None
    reward: float
    state: Array
    frames: list[Array]


def bench_buffer(config: BenchBufferConfig) -> dict[str, Any]:
    """Bytes per transition, need for 500,000, time steps added a second and milliseconds per batch:
    of the packed buffer, under ``plain`` of the plain one, and their ratios.

    Raises UserError if too little is asked for to say anything.
    """
    if config.decisions <= TOGETHER:
        raise UserError(f"expected more than {TOGETHER} --decisions, found {config.decisions}")
    env = make_env(config.task)
    try:
        facts = env.spec
        recorded = list(_record(env, config.decisions))
    finally:
        env.close()
    streams = tuple(camera.name for camera in facts.cameras)
    spec = BufferSpec(
        streams, facts.state_dim, facts.action_dim, len(recorded), horizon=facts.horizon
    )
    plain = ReplayBuffer(spec)
    packed = ReplayBuffer(replace(spec, packed=True))
    adding = {name: _add(b, recorded) for name, b in (("plain", plain), ("packed", packed))}
    times, cpu = _sampling({"plain": plain, "packed": packed}, config)
    sizes = _sizes(packed, spec)
    result = {"schema": 1, "task": config.task}
    result |= {"streams": list(streams), "instants": len(recorded), "batch_size": config.batch_size}
    figures = {
        name: {
            "bytes_per_transition": round(size),
            "gb_at_500k": round(size * PAPER / 1e9, 2),
            "add_per_s": round(1 / adding[name]),
            "sample_ms": round(1000 * times[name], 2),
            "sample_cpu_ms": round(1000 * cpu[name], 2),
        }
        for name, size in sizes.items()
    }
    result |= {**figures["packed"], "plain": figures["plain"]}
    result["times_smaller"] = round(sizes["plain"] / sizes["packed"], 2)
    result["times_slower_to_sample"] = round(cpu["packed"] / cpu["plain"], 2)
    if config.fill:
        result["filled"] = _fill(replace(spec, packed=True, capacity=config.fill), recorded, config)
    return result


def _record(env: Environment, decisions: int) -> Iterator[RecordedStep]:
    """Whole episodes of at least ``decisions`` in all, every second one the expert's."""
    rng = np.random.default_rng(0)
    cameras = [camera.name for camera in env.spec.cameras]
    for episode in range(-(-decisions // env.spec.horizon)):
        now = env.reset(episode)
        action = None
        while True:
            frames = [env.view(camera).rgb for camera in cameras]
            yield RecordedStep(action, now.reward, now.state, frames)
            if now.last:
                break
            drawn = rng.uniform(-1, 1, env.spec.action_dim).astype(np.float32)
            action = env.expert() if episode % 2 else drawn
            now = env.step(action)


def _add(buffer: ReplayBuffer, recorded: list[RecordedStep]) -> float:
    """Adds all of it; seconds for each time step."""
    began = time.perf_counter()
    for each in recorded:
        if each.action is None:
            buffer.begin(each.state, each.frames)
        else:
            buffer.add(each.action, each.reward, 0.99, each.state, each.frames)
    return (time.perf_counter() - began) / len(recorded)


def _sampling(
    sides: dict[str, ReplayBuffer], config: BenchBufferConfig
) -> tuple[dict[str, float], dict[str, float]]:
    """Median seconds for a batch, by the clock and of this thread; each round both sides put the
    same transitions together."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in sides}
    for number in range(config.rounds + 1):
        batches = []
        for name in sorted(sides, reverse=number % 2 == 1):
            rng = np.random.default_rng(number)
            *seconds, batch = _timed(lambda: sides[name].sample(config.batch_size, rng))  # noqa: B023
            times[name].append((seconds[0], seconds[1]))
            batches.append(batch)
        first, second = batches
        if not (first.views.equal(second.views) and first.next_views.equal(second.next_views)):
            raise RuntimeError("packed frames came back changed")
    by_the_clock = {name: median(t for t, _ in each[1:]) for name, each in times.items()}
    of_the_thread = {name: median(t for _, t in each[1:]) for name, each in times.items()}
    return by_the_clock, of_the_thread


def _timed(work: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds by the clock, seconds of this thread, and what ``work`` returned."""
    began = time.perf_counter()
    began_cpu = time.thread_time()
    result = work()
    return time.perf_counter() - began, time.thread_time() - began_cpu, result


def _sizes(packed: ReplayBuffer, spec: BufferSpec) -> dict[str, float]:
    """Bytes per transition in a long run: an episode has one time step more than transitions."""
    more = (spec.horizon + 1) / spec.horizon
    numbers = spec.bytes_per_row - spec.frame_bytes
    return {
        "plain": more * spec.bytes_per_row,
        "packed": more * (packed.packed_bytes_per_row + numbers),
    }


def _fill(
    spec: BufferSpec, recorded: list[RecordedStep], config: BenchBufferConfig
) -> dict[str, Any]:
    """A packed buffer of ``spec.capacity`` transitions, made for real."""
    before = _occupied()
    buffer = ReplayBuffer(spec)
    began = time.perf_counter()
    while len(buffer) < spec.capacity:
        _add(buffer, recorded)
    seconds = time.perf_counter() - began
    count = len(buffer)
    grown = _occupied() - before
    rng = np.random.default_rng(0)
    times = [_timed(lambda: buffer.sample(config.batch_size, rng)) for _ in range(config.rounds)]
    return {
        "transitions": count,
        "seconds": round(seconds, 1),
        "process_grew_gb": round(grown / 1e9, 3),
        "bytes_per_transition": round(grown / count),
        "gb_at_500k": round(grown / count * PAPER / 1e9, 2),
        "sample_ms": round(1000 * median(t for t, _, _ in times), 2),
        "sample_cpu_ms": round(1000 * median(t for _, t, _ in times), 2),
    }


def _occupied() -> int:
    """Bytes of memory this process occupies."""
    occupied = kilobytes("VmRSS")
    if occupied is None:
        raise UserError("expected Linux for --fill, found no /proc/self/status; leave --fill out")
    return 1024 * occupied
