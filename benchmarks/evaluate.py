"""``benchmarks evaluate``: episodes a minute in worker processes, in one process, drawn as stock.

An evaluation is drawing and little else: a decision of hammer takes 15 to 20 ms, 13 of which go
into three pictures. So three ways to run the same policy are compared:

    ours     worker processes, one per core, under the policy's render profile
    serial   the same episodes, one after the other in this process; the results must be the same
    stock    that loop again, with pictures by the simulator's own renderer under its own settings

A stock picture takes some 18 times as long, and every decision of an episode the same: so some are
timed, and their median is counted for all of them. Starting processes is not counted, because a
table of 400 episodes does it once: there are episodes to run before the clock does.
"""

from __future__ import annotations

import os
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.render import STOCK, Frames
from benchmarks.stock import stock_frames
from madviz.errors import UserError
from madviz.measure.episodes import FIRST_SEED, Finished, Job, Runner, one_thread
from madviz.measure.workers import Workers, run_jobs
from madviz.observation.condition import Condition
from madviz.observation.streams import IMAGE_SIZE
from madviz.policies import checkpoint
from madviz.subsets import cameras_of, mask_of
from madviz.system.numbers import Count, Seed, Threads
from madviz.types import Array, Policy


@dataclass(frozen=True)
class BenchEvaluateConfig:
    """Counts the episodes a minute of an evaluation, against a plain loop and a stock one."""

    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""
    policy: checkpoint.PolicyName = "metaworld-hammer-mad-light"
    """A policy folder that takes RGB of the suite's three cameras."""
    subset: str = "all"
    """The streams the policy is given, for example ``all``, ``first`` or ``first+third_a``."""
    episodes: Count = 20
    """Episodes that our workers and the serial loop run."""
    seed: Seed = FIRST_SEED
    """The seed of the first episode."""
    workers: Threads | None = None
    """Processes; by default one per core."""
    stock_decisions: Count = 10
    """Decisions of the stock loop that are timed."""


def bench_evaluate(config: BenchEvaluateConfig) -> dict[str, Any]:
    """``ours``, ``serial`` and ``stock`` in episodes a minute, and the two ratios. Raises UserError
    for what cannot be measured, and where the two loops disagree about an episode."""
    count = config.workers or os.cpu_count() or 1
    spec = checkpoint.describe(config.policy).spec
    if spec.task.split("/")[0] not in STOCK:
        raise UserError(f"expected a policy of {' or '.join(STOCK)}, found one for {spec.task}")
    seeds = range(config.seed, config.seed + config.episodes)
    condition = Condition(config.subset).noticed(spec.streams)
    jobs = [Job(config.policy, spec.digest, condition, seed) for seed in seeds]
    here = Runner()
    there = Workers(count)
    ours_seconds, ours = in_workers(jobs, there)
    serial_seconds, serial = in_turn(jobs, here)
    if ours != serial:
        raise UserError("expected the same results of both loops, found different ones; see doctor")
    env, policy = here.opened(jobs[0])
    mask = mask_of(config.subset, spec.streams)
    frames = stock_frames(spec.task, IMAGE_SIZE)
    repeat = env.spec.action_repeat
    decisions = config.stock_decisions
    decision = stock_seconds(frames, policy, mask, repeat, decisions)
    frames.close()
    here.close()
    rates = {
        "ours": 60 * len(jobs) / ours_seconds,
        "serial": 60 * len(jobs) / serial_seconds,
        "stock": 60 / (decision * env.spec.horizon),
    }
    return {
        "schema": 1,
        "ours": round(rates["ours"], 2),
        "serial": round(rates["serial"], 2),
        "stock": round(rates["stock"], 2),
        "ratio_serial": round(rates["ours"] / rates["serial"], 2),
        "ratio_stock": round(rates["ours"] / rates["stock"], 2),
        "policy": spec.name,
        "task": spec.task,
        "subset": config.subset,
        "seed": config.seed,
        "episodes": len(jobs),
        "workers": count,
        "horizon": env.spec.horizon,
        "successes": sum(result.success for result, _ in serial.values()),
        "worker_mb": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024),
    }


def in_workers(
    jobs: list[Job], workers: Workers, clock: Callable[[], float] = time.perf_counter
) -> tuple[float, dict[Job, Finished]]:
    """Seconds that ``workers`` take for ``jobs`` once they run, and the results. Closes them."""
    # Twice as many as there are processes: one that starts late finds one that is left.
    for future in [workers.submit(jobs[0]) for _ in range(2 * workers.count)]:
        future.result()
    began = clock()
    found = dict(run_jobs(jobs, workers))
    return clock() - began, found


def in_turn(
    jobs: list[Job], runner: Runner, clock: Callable[[], float] = time.perf_counter
) -> tuple[float, dict[Job, Finished]]:
    """Seconds that this process takes for ``jobs``, one after the other, and the results."""
    runner.run(jobs[0])
    began = clock()
    found = {job: runner.run(job) for job in jobs}
    return clock() - began, found


def stock_seconds(
    frames: Frames,
    policy: Policy,
    mask: Array,
    repeat: int,
    decisions: int,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Median seconds of a decision: pictures, what the policy makes of them, the steps."""
    streams = policy.spec.streams
    if len(cameras_of(streams)) != len(frames.draw()) or len(streams) != len(cameras_of(streams)):
        raise UserError(f"expected a policy with RGB of three cameras, found {list(streams)}")
    state = np.zeros(policy.spec.state_dim, np.float32)
    times = []
    with one_thread():
        for _ in range(decisions + 1):
            began = clock()
            pictures = np.stack([np.moveaxis(picture, -1, 0) for picture in frames.draw()])
            stack = np.tile(pictures, (1, policy.spec.frame_stack, 1, 1))
            policy.read(policy.encode(stack, state), mask[None])
            for _ in range(repeat):
                frames.step()
            times.append(clock() - began)
    return statistics.median(times[1:])
