"""The loop around a run of reinforcement learning: evaluate, save, advance, report.

    while not finished:
        an evaluation that is due        a row of curve.csv, and curve.svg
        a checkpoint that is due         resume state, and the policy as it ships
        run.advance()                    decisions and updates, as the recipe has them

It knows nothing about how a recipe acts and learns; ``paper`` and ``vectorised`` do.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from madviz.measure.episodes import Stopped
from madviz.runs.curve import draw_curve
from madviz.runs.reward_run import RewardRun
from madviz.runs.run_folder import interruptible

PROGRESS_SECONDS = 20
"""Between lines that say how far a run is."""


def train_on(run: RewardRun) -> None:
    """From the folder's last state, if it has one, to the end of the run or a Ctrl-C."""
    state = run.folder.load_state()
    if state:
        run.restore(state)
    # Whatever was reported after that state will be reported again.
    run.folder.truncate_curve("step", run.step if state else -1)
    _loop(run)


def _loop(run: RewardRun) -> None:
    saved, began = run.step, time.monotonic() - run.seconds
    reported, speed = time.monotonic(), Speed(run)
    with interruptible(run.folder) as stop:
        while True:
            if run.evaluation_due():
                _evaluate(run, stop.is_set, speed)
                speed = Speed(run)
            run.seconds = time.monotonic() - began
            if run.finished or stop.is_set() or run.step - saved >= run.config.save_every:
                _save(run)
                saved = run.step
            if run.finished or stop.is_set():
                break
            before = time.monotonic()
            run.advance()
            now = time.monotonic()
            run.busy += now - before
            if now - reported > PROGRESS_SECONDS:
                _report(run, speed)
                reported = now
        # Not where somebody stopped it: the last evaluation may still be due.
        if run.finished and not stop.is_set():
            run.folder.finish()


class Speed:
    """How fast a run goes since now; evaluating and saving are left out."""

    def __init__(self, run: RewardRun) -> None:
        self._run, self._before = run, (run.env_steps, run.updates, run.busy)

    def now(self) -> dict[str, float]:
        """Simulator steps and updates per second."""
        run, (steps, updates, busy) = self._run, self._before
        seconds = max(run.busy - busy, 1e-9)
        return {
            "env_steps_per_s": round((run.env_steps - steps) / seconds, 2),
            "updates_per_s": round((run.updates - updates) / seconds, 3),
        }


def _evaluate(run: RewardRun, stop: Callable[[], bool], speed: Speed) -> None:
    """A row of the curve, and the picture of all rows."""
    try:
        row = run.evaluate(stop)
    except Stopped:
        return  # It is due again when the run goes on.
    counts = {"step": run.step, "env_steps": run.env_steps, "updates": run.updates}
    losses = {name: round(run.losses.get(name, float("nan")), 5) for name in run.LOSSES}
    left = _seconds_left(run) if run.step else ""
    clock = {"seconds": round(run.seconds, 1), "seconds_left": left, **speed.now()}
    episodes = {"episodes": run.config.eval_episodes}
    run.folder.report("curve", **counts, **clock, **episodes, **row, **losses)
    draw_curve(run.folder.path, run.plan.spec.name, run.config.steps)


def _report(run: RewardRun, speed: Speed) -> None:
    run.folder.report(
        "progress",
        step=run.step,
        steps=run.config.steps,
        episodes=run.episodes,
        updates=run.updates,
        seconds_left=_seconds_left(run),
        **speed.now(),
        **{name: round(value, 4) for name, value in run.losses.items()},
    )


def _seconds_left(run: RewardRun) -> int:
    """At the rate of all that was done so far, evaluations included."""
    return round(run.seconds / max(run.step, 1) * max(run.config.steps - run.step, 0))


def _save(run: RewardRun) -> None:
    """Resume state, then the policy in its shipped form."""
    run.folder.save_state(run.state())
    run.saved()
    run.plan.save(run.folder, run.acting_agent(), run.record())
