"""Shapes and types at the package's boundary, checked whenever a test crosses it."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

MODULES = (
    "madviz.types",
    "madviz.agent.objectives",
    "madviz.agent.agent",
    "madviz.analysis.probes",
    "madviz.analysis.projection",
)
"""Whose annotations are checked."""

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Checks a function's arguments and result; an int may stand for a float."""
