"""madviz's tasks as a benchmark of vla-eval: it plays them, whoever serves the policy.

An observation has the pictures under the names of madviz's cameras, and ``state``, as madviz's own
server takes them. Episode k of a task is the one of seed ``seed`` + k, as everywhere in madviz.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task

import madviz  # noqa: F401 - It tells Gymnasium of its tasks.


class MadvizBenchmark(StepBenchmark):
    """Tasks by their Gymnasium names; ``drop``: cameras that no policy is sent."""

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        return {}  # madviz finds out by itself what it can draw with.

    def __init__(
        self, tasks: list[str] | None = None, seed: int = 5000, drop: list[str] | None = None
    ) -> None:
        super().__init__()
        self._tasks, self._seed, self._drop = tasks or ["reach-v0"], seed, drop or []
        self._env: gymnasium.Env | None = None
        self._name = ""

    def get_tasks(self) -> list[Task]:
        return [{"name": name, "suite": "madviz"} for name in self._tasks]

    def reset(self, task: Task) -> Any:
        if task["name"] != self._name:
            self.cleanup()
            self._name = task["name"]
            self._env = gymnasium.make(f"madviz/{self._name}", depth=False)
        seen, _ = self._env.reset(seed=self._seed + int(task.get("episode_idx", 0)))
        return seen

    def step(self, action: Action) -> StepResult:
        decided = np.asarray(action["actions"], np.float32).reshape(-1)
        seen, reward, terminated, truncated, info = self._env.step(decided)
        return StepResult(seen, float(reward), bool(terminated or truncated), info)

    def make_obs(self, raw_obs: Any, task: Task) -> Observation:
        images = {name: each for name, each in raw_obs["pixels"].items() if name not in self._drop}
        words = self._env.unwrapped.task_description
        return {"images": images, "state": raw_obs["agent_pos"], "task_description": words}

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        return {"success": bool(step_result.info.get("is_success", False))}

    def get_action_spec(self) -> dict[str, DimSpec]:
        count = gymnasium.make(f"madviz/{self._tasks[0]}", depth=False).action_space.shape[0]
        return {"actions": DimSpec("actions", count, "raw", (-1.0, 1.0))}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        return {"images": DimSpec("images", 0, "rgb"), "state": DimSpec("state", 0, "raw")}

    def get_metadata(self) -> dict[str, Any]:
        return {"max_steps": 500}

    def cleanup(self) -> None:
        if self._env is not None:
            self._env.close()
        self._env = None
