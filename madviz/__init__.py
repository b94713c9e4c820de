"""Take a camera away from a multi-view robot policy, live, and see what it does then.

    import madviz

    env = madviz.make_env("metaworld/hammer")
    policy = madviz.load_policy("metaworld-hammer-mad-light")
    madviz.explore(madviz.ExploreConfig(policy="metaworld-hammer-mad-light"))

Importing this loads neither torch nor viser; the names below load what they need when used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from madviz.app.server import ExploreConfig as ExploreConfig
    from madviz.app.server import explore as explore
    from madviz.checkpoint import load_policy as load_policy
    from madviz.envs.base import make_env as make_env
    from madviz.types import UserError as UserError

__version__ = "0.1.0"

_HOMES = {
    "ExploreConfig": "madviz.app.server",
    "explore": "madviz.app.server",
    "load_policy": "madviz.checkpoint",
    "make_env": "madviz.envs.base",
    "UserError": "madviz.types",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"madviz has no {name!r}; public names: {', '.join(_HOMES)}")
    return getattr(import_module(_HOMES[name]), name)
