"""The code that a copy's kernel runs in place of a check: the installed package's judgement, as an
output that a program reads. Nothing else of ``madviz.grading`` is loaded there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from madviz.teaching.checks import CHECKS, judge

MIME = "application/vnd.madviz.check+json"


def report(name: str, names: Mapping[str, Any]) -> None:
    """Judges what a copy's ``names`` hold; a name that is not there is a missing answer."""
    from IPython.display import publish_display_data

    result = judge(name, *(names.get(word) for word in CHECKS[name].takes))
    publish_display_data({MIME: asdict(result), "text/plain": repr(result)})
