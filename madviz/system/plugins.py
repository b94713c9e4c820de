"""``module:factory``: an object from a user's own code, which may lie in the working directory."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import Any, get_type_hints

from madviz.errors import UserError
from madviz.system.collection import imported


def load(reference: str) -> Any:
    """The object that ``module:name`` names, imported now. Raises ImportError or AttributeError."""
    module, _, name = reference.partition(":")
    return getattr(imported(module), name)


def made_by(reference: str, protocol: type) -> Any:
    """The object that ``module:factory`` returns. Raises UserError where it cannot be imported, and
    where the result lacks a part that ``protocol`` has, or has another kind of ``spec``."""
    try:
        with _importable_from_here():
            factory = load(reference)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise UserError(
            f"{reference}: expected module:factory that can be imported from here, found: {error}"
        ) from error
    try:
        with _importable_from_here():
            made = factory()
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        inside = extract_tb(error.__traceback__)[1:]  # The first frame is this function's.
        place = f" ({Path(inside[-1].filename).name}, line {inside[-1].lineno})" if inside else ""
        raise UserError(
            f"{reference}: expected module:factory that can be called without arguments, found "
            f"{type(error).__name__}: {error}{place}"
        ) from error
    parts = [*protocol.__annotations__, *vars(protocol)]
    lacking = [part for part in parts if part[0] != "_" and not hasattr(made, part)]
    if lacking:
        raise UserError(
            f"{reference}: expected a {protocol.__name__} ({protocol.__module__}), found a "
            f"{type(made).__name__} without {', '.join(lacking)}; return an object that has them"
        )
    kind = get_type_hints(protocol)["spec"]
    if not isinstance(made.spec, kind):
        raise UserError(
            f"{reference}: expected a spec of the kind {kind.__module__}.{kind.__name__}, found a "
            f"{type(made.spec).__name__}; fill one in"
        )
    return made


@contextmanager
def _importable_from_here() -> Iterator[None]:
    """Adds the working directory to the path, which console scripts leave out."""
    sys.path.insert(0, os.getcwd())
    try:
        yield
    finally:
        sys.path.remove(os.getcwd())
