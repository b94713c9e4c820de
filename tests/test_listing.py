"""``madviz list``: what it prints of tasks, settings, methods and policies."""

from __future__ import annotations

from pathlib import Path

import pytest

from madviz.policies import checkpoint
from madviz.policies.listing import ListConfig, catalogue, run_list
from tests.evidence import rates, write_policy


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two policies without weights are all there is."""
    whole = write_policy(tmp_path, rates(0.95, 0.9, 0.85, 0.8))
    alone = write_policy(
        tmp_path, {"all": 0.4}, method="single", camera="third_a", first_seed=40_000
    )
    found = {whole.name: whole, alone.name: alone}
    monkeypatch.setattr(checkpoint, "policy_folders", dict)
    monkeypatch.setattr(checkpoint, "measured_folders", lambda: found)


def words(config: ListConfig | None = None) -> str:
    return catalogue(run_list(config or ListConfig()))


@pytest.mark.usefixtures("bare")
def test_policies_without_weights_are_counted_and_listed_on_demand() -> None:
    few = words()
    assert "policies: none found" in few
    assert few.endswith("2 more have no weights here: `madviz list --all`")
    lines = words(ListConfig(all=True)).splitlines()
    mad, single = lines[lines.index("without weights, success rates only:") + 1 :]
    assert mad.split() == [
        "metaworld-hammer-mad-light", "all", "0.95", "[0.89,", "0.98]", "n=100,", "development",
        "seeds",
    ]  # fmt: skip
    assert single.split()[1:3] == ["third_a", "0.40"] and single.endswith(" reporting seeds")


@pytest.mark.usefixtures("bare")
def test_settings_say_their_streams_and_methods_what_they_are() -> None:
    lines = words().splitlines()
    assert "  one-rgbd          third_a.rgb, third_a.depth" in lines
    assert any(line.startswith("  mad               merge and disentangle") for line in lines)
    assert any(line.startswith("  metaworld/") and "metaworld/hammer" in line for line in lines)
