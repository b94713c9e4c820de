"""Switch off a robot's camera, live, and watch what happens.

    import madviz

    env = madviz.make_env("metaworld/hammer")
    policy = madviz.load_policy("metaworld-hammer-mad-light")
    rates = madviz.evaluate("metaworld-hammer-mad-light", episodes=20).rows
    madviz.explore(madviz.ExploreConfig(policy="metaworld-hammer-mad-light"))

Importing this loads neither torch nor viser; the names below load what they need when used. Where
Gymnasium is loaded already, it learns the names of the tasks: gymnasium.make("madviz/hammer-v0").
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from madviz.app.server import ExploreConfig as ExploreConfig
    from madviz.app.server import explore as explore
    from madviz.envs.custom import allow_task as allow_task
    from madviz.envs.registry import make_env as make_env
    from madviz.errors import UserError as UserError
    from madviz.measure.audit.audit import audit as audit
    from madviz.measure.episodes import run_episode as run_episode
    from madviz.measure.evaluate import evaluate as evaluate
    from madviz.policies.checkpoint import load_policy as load_policy
    from madviz.policies.checkpoint import save_policy as save_policy
    from madviz.policies.listing import list_policies as list_policies

__version__ = "0.1.0"

PUBLIC = {
    "ExploreConfig": "madviz.app.server",
    "allow_task": "madviz.envs.custom",
    "audit": "madviz.measure.audit.audit",
    "evaluate": "madviz.measure.evaluate",
    "explore": "madviz.app.server",
    "list_policies": "madviz.policies.listing",
    "load_policy": "madviz.policies.checkpoint",
    "make_env": "madviz.envs.registry",
    "run_episode": "madviz.measure.episodes",
    "save_policy": "madviz.policies.checkpoint",
    "UserError": "madviz.errors",
}
"""Each public name, and the module where it is."""


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"madviz has no {name!r}; public names: {', '.join(PUBLIC)}")
    return getattr(import_module(PUBLIC[name]), name)


if "gymnasium" in sys.modules:
    from madviz.envs import gymnasium_env as gymnasium_env
