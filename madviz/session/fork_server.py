"""Modules that simulations share: imported once, by the process that they are forked from.

Importing this module is its whole purpose. ``SHARED`` is all that a simulation needs, with what
torch and its simulator import late: two seconds and 360 MB that each would have for itself. No
simulator is among it, as OpenGL does not survive a fork; ``app/forking.py`` says what of one does
and has it imported before this. Garbage collection leaves the objects of before the fork
alone from then on: going through them writes into each, and memory that was written to is not
shared any more (64 MB). What garbage there is then, 2 MB, stays: finding it would take 0.2 s.
"""

import gc
from contextlib import suppress
from importlib import import_module

SHARED = (
    "gymnasium",
    "imageio",
    "madviz.agent.agent",
    "madviz.envs.shapes",
    "madviz.policies.checkpoint",
    "madviz.session.process",
    "safetensors.torch",
    "scipy.spatial.transform",
    "torch._meta_registrations",
)

for name in SHARED:
    with suppress(ImportError):  # Whoever needs it says so; another package may do without.
        import_module(name)
gc.freeze()
gc.enable()
