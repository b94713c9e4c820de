"""A sweep's runs on a Ray cluster; ray is an optional dependency and imported only here.

Every node must see the same folder: it holds all state, Ray only says who works when. If a worker
or a whole node dies, Ray starts the run again elsewhere; that finds the folder, and either resumes,
or sees the result and does nothing. A node that was only cut off may still be at work: its claim is
then taken, and the run comes back as busy until it has ended.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from madviz.envs.custom import allow_task, own_tasks
from madviz.errors import UserError
from madviz.sweep.run import Run, RunOutcome, carry_out

RETRIES = 20
"""How many deaths of workers or nodes a run may survive within one sweep."""


class RayBackend:
    """See the module; the methods are those of ``madviz.sweep.sweep.LocalBackend``."""

    def __init__(
        self,
        out: Path,
        jobs: int | None,
        address: str | None = None,
        cpus: int = 2,
        program: Sequence[str] = (),
    ) -> None:
        """Connects, or starts a cluster on this machine. Raises UserError where ray is missing or
        the cluster cannot be reached."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Runs are not reported to others.
        self._ray = _ray()
        self._mine = not self._ray.is_initialized()
        if self._mine:
            self._connect(address or os.environ.get("RAY_ADDRESS"), cpus)
        self._check_cores(cpus)
        self._jobs = jobs
        self._cpus = cpus
        self._arguments = (own_tasks(), out.resolve(), tuple(program), cpus)
        self._task = self._ray.remote(num_cpus=cpus, max_retries=RETRIES)(_on_node)
        self._running: dict[Any, Run] = {}

    @property
    def slots(self) -> int:
        """The number of runs that fit on the nodes that are alive now; 1 at least, which then waits
        for a node."""
        fits = sum(int(cores // self._cpus) for cores in self._cores())
        return max(min(fits, self._jobs or fits), 1)

    def submit(self, run: Run) -> None:
        self._running[self._task.remote(run, *self._arguments)] = run

    def collect(self, seconds: float) -> list[tuple[Run, RunOutcome]]:
        done, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        return [(self._running.pop(reference), self._outcome(reference)) for reference in done]

    def close(self) -> None:
        for reference in self._running:
            # Ends the worker process; its command then gets SIGTERM and saves before it ends.
            self._ray.cancel(reference, force=True)
        if self._mine:
            self._ray.shutdown()

    def _outcome(self, reference: Any) -> RunOutcome:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            reason = str(error).strip().splitlines()[0]
            return RunOutcome("failed", f"Ray gave the run up ({type(error).__name__}): {reason}")

    def _connect(self, address: str | None, cpus: int) -> None:
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "warning"}
        try:
            if address:
                self._ray.init(address=address, **quiet)
            else:
                cores = max(os.cpu_count() or 1, cpus)
                self._ray.init(num_cpus=cores, include_dashboard=False, **quiet)
        except Exception as error:  # On a busy machine Ray raises a bare one: it timed out.
            raise UserError(
                f"expected a Ray cluster at {address or 'this machine'}, found: {error}; "
                "start one with `ray start --head`, or leave --backend ray out"
            ) from error

    def _check_cores(self, cpus: int) -> None:
        largest = max(self._cores(), default=0)
        if largest < cpus:
            raise UserError(
                f"expected a node with {cpus} cores for a run, found {largest:g} at most; "
                f"give --cpus {max(int(largest), 1)}"
            )

    def _cores(self) -> list[float]:
        """The cores of every node that is alive."""
        return [n["Resources"].get("CPU", 0) for n in self._ray.nodes() if n["Alive"]]


def _on_node(
    run: Run, tasks: Sequence[str], out: Path, program: Sequence[str], cpus: int
) -> RunOutcome:
    """``carry_out`` in a process that does not know the driver's own tasks yet: nodes
    have the environment variables that they were started with."""
    for task in tasks:
        allow_task(task)
    return carry_out(run, out, program, cpus)


def _ray() -> Any:
    try:
        import ray

        return ray
    except ImportError as error:
        raise UserError(
            "expected the package ray, found none; install it with "
            "`pip install 'madviz[cluster]'`, or leave --backend ray out"
        ) from error
