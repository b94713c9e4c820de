"""How many cores and how much memory a process may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from madviz.system import machine


def test_cores_are_those_that_this_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5})
    assert machine.cores() == 2


def test_a_containers_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "GROUP", tmp_path)
    whole = machine.free_memory()
    for name, text in (("current", "700"), ("stat", "anon 400\ninactive_file 300\n")):
        (tmp_path / f"memory.{name}").write_text(text)
    (tmp_path / "memory.max").write_text("1000\n")
    assert machine.free_memory() == 600
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.free_memory() == pytest.approx(whole, rel=0.2)
