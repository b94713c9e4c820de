"""Actions outside [-1, 1] are clipped, counted and said."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from madviz.cli import main
from madviz.measure.audit.account import account
from madviz.measure.audit.along import along
from madviz.measure.audit.along_account import along_words
from madviz.measure.audit.audit import AuditConfig, run_audit
from madviz.measure.blocks import html
from madviz.measure.compare import CompareConfig, compare_policies, comparison_table
from madviz.measure.evaluate import evaluate
from madviz.measure.store import EpisodeResult, ResultKey, Store
from madviz.system.files import read_json, write_json
from madviz.wire.reference import with_wire
from tests.evidence import rates, write_policy
from tests.fakes import FakePolicy
from tests.wires import foreign_server, wiring_file

SAID = "50 % of the policy's action numbers lay outside [-1, 1] and were clipped"


def tenfold(look: dict[str, Any], connection: object) -> dict[str, Any]:
    """One number in range and one that is not, in each of three decisions."""
    return {"actions": np.array([[10.0, 0.5], [0.5, -3.0], [1.0, 2.0]], np.float32)}


class Wild(FakePolicy):
    """Acts here, and beyond the range."""

    def read(self, encoded: Any, masks: Any) -> Any:
        readout = super().read(encoded, masks)
        readout.action[:] = (7.0, 0.5)
        return readout


def test_eval_counts_prints_and_stores_them(tmp_path, capsys):
    with foreign_server(tenfold) as address:
        wire, out = str(wiring_file(tmp_path, chunk="3")), tmp_path / "out.json"
        words = ["eval", "--policy", address, "--wire", wire, "--subsets", "all", "--episodes", "2"]
        assert main([*words, "--workers", "0"]) == 0
        assert SAID in capsys.readouterr().out
        assert main([*words, "--workers", "1", "--json", str(out)]) == 0
    assert json.loads(out.read_text())["subsets"]["all"]["outside"] == 0.5


@pytest.mark.parametrize(("policy", "share"), [(Wild(), 0.5), (FakePolicy(), 0.0)])
def test_those_of_a_policy_here_are_counted_too(policy, share):
    assert evaluate(policy, ["all"], episodes=1).rows["all"].get("outside") == share


def test_an_audit_along_an_axis_counts_and_prints_them():
    found = along(Wild(), ["third_a.right=0:0.2"], seed=5000, episodes=8)
    assert found["outside"] == 0.5
    assert SAID in "\n".join(along_words(found))


def test_compare_says_them_of_each_policy(tmp_path):
    tame = write_policy(tmp_path, rates(0.9, 0.9, 0.9, 0.9))
    wild = write_policy(tmp_path, rates(0.9, 0.9, 0.9, 0.9), method="merged-only")
    measured = read_json(wild / "evaluation.json")
    for row in measured["subsets"].values():
        row["outside"] = 0.5
    write_json(wild / "evaluation.json", measured)
    found = compare_policies(CompareConfig((str(tame), str(wild))))
    assert [policy.get("outside") for policy in found["policies"]] == [0.0, 0.5]
    words = comparison_table(found)
    assert f"metaworld-hammer-merged-only-light: {SAID}" in words and words.count("clipped") == 1


def test_an_audit_says_them_beside_its_verdicts_also_when_it_goes_on(tmp_path):
    with foreign_server(tenfold) as address:
        wire = wiring_file(tmp_path, chunk="3")
        config = AuditConfig(
            address, tmp_path / "out", episodes=2, how=("dropped",), workers=0, wire=wire
        )
        found = run_audit(config)
        again = run_audit(config)  # All episodes come from the folder.
    assert found.get("outside") == again.get("outside") == 0.5
    assert json.loads((tmp_path / "out" / "audit.json").read_text())["outside"] == 0.5
    for name in ("audit.md", "audit.html"):
        assert (tmp_path / "out" / name).read_text().count("action numbers lay outside") == 2
    assert "shapley" in found
    found["outside"] = 0.0
    assert "lay outside" not in html(account(found, ""))


def test_the_command_that_compares_conditions_says_them(tmp_path, capsys):
    with foreign_server(tenfold) as address:
        reference = with_wire(address, wiring_file(tmp_path, chunk="3"))
        words = ["--conditions", "all", "first", "--episodes", "1", "--workers", "0"]
        assert main(["compare", reference, *words]) == 0
    assert SAID in capsys.readouterr().out


def test_a_store_keeps_the_share_and_what_a_guard_noticed(tmp_path):
    key = ResultKey("digest", "toy/reach", "near", "fast", "", "all")
    store = Store(tmp_path / "a.sqlite")
    results = [EpisodeResult("all", n, True, True, 1.0, n / 4, (None, 0, 3)[n]) for n in range(3)]
    for result in results:
        store.put(key, result)
    assert list(store.results(key).values()) == results
    store.close()
    again = Store(tmp_path / "a.sqlite")
    assert list(again.results(key).values()) == results
