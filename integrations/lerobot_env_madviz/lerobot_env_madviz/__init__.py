"""madviz's tasks in LeRobot: ``lerobot-eval --env.type=madviz --env.task=hammer-v0``.

LeRobot imports every installed package whose name begins with ``lerobot_env_``; importing this one
makes the type known. An environment is then ``gymnasium.make("madviz/hammer-v0")``, whose names are
LeRobot's already. Cameras, state and action are read from it, so nothing else has to be said.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import gymnasium
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

import madviz  # noqa: F401 - It tells Gymnasium of its tasks.


@EnvConfig.register_subclass("madviz")
@dataclass
class MadvizEnvConfig(EnvConfig):
    """One task; ``size`` in pixels. An episode is the one of its seed, as in madviz."""

    task: str = "hammer-v0"
    fps: int = 10
    size: int = 84
    render_profile: str = "fast"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        env = gymnasium.make(self.gym_id, disable_env_checker=True, **self.gym_kwargs)
        spaces, action = env.observation_space, env.action_space
        env.close()
        for camera, space in spaces["pixels"].items():
            self._add(f"pixels/{camera}", f"{OBS_IMAGES}.{camera}", FeatureType.VISUAL, space.shape)
        self._add("agent_pos", OBS_STATE, FeatureType.STATE, spaces["agent_pos"].shape)
        self._add(ACTION, ACTION, FeatureType.ACTION, action.shape)

    @property
    def package_name(self) -> str:
        return "madviz"

    @property
    def gym_kwargs(self) -> dict:
        """Of ``gymnasium.make``; the policies of LeRobot take no depth."""
        return {
            "size": self.size,
            "depth": False,
            "render_profile": self.render_profile,
            "render_mode": "rgb_array",
        }

    def _add(self, ours: str, theirs: str, kind: FeatureType, shape: tuple[int, ...]) -> None:
        self.features[ours] = PolicyFeature(type=kind, shape=shape)
        self.features_map[ours] = theirs
