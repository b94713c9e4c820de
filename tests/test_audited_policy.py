"""An audit goes on with the policy and the seed with which it began, or refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from madviz.errors import Unfinished, UserError
from madviz.measure.audit.audit import AuditConfig, run_audit
from madviz.measure.evaluate import evaluate
from madviz.policies.checkpoint import load_policy
from madviz.wire.reference import with_wire
from tests.fakes import FakePolicy
from tests.wires import foreign_server, towards_bright, wiring_file

PROTOCOLS = ["vla-eval", "openpi"]
OPTIONS: dict[str, Any] = {"episodes": 1, "how": ("black",), "workers": 0, "pairs": 0}


def config_of(address: str, folder: Path) -> AuditConfig:
    wire = wiring_file(folder, cameras='{ first = "wrist" }')
    return AuditConfig(address, folder / "out", wire=wire, **OPTIONS)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", ["model", "digest"])
def test_another_name_at_the_same_address_is_refused(protocol, name, tmp_path):
    says = {name: "one"}
    with foreign_server(lambda *_: {"actions": np.zeros(2)}, protocol, says) as address:
        config = config_of(address, tmp_path)
        run_audit(config)
        run_audit(replace(config, episodes=2))
        stored = json.loads((tmp_path / "out" / "policy.json").read_text())
        assert stored["identity"] == says and (stored["answer"] is None) == (name == "digest")
        says[name] = "two"
        with pytest.raises(UserError, match="says .*'one'.*found .*'two'.*choose another folder"):
            run_audit(replace(config, episodes=3))


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_server_that_says_nothing_is_known_by_its_answer(protocol, tmp_path):
    action = [0.25, -0.5]
    with foreign_server(lambda *_: {"actions": np.array(action)}, protocol) as address:
        config = config_of(address, tmp_path)
        run_audit(config)
        action[0] += 1e-5
        run_audit(replace(config, episodes=2))
        action[0] = 0.5
        with pytest.raises(UserError, match=r"\[0.25, -0.5\] with which .* found \[0.5, -0.5\]"):
            run_audit(replace(config, episodes=3))


def test_a_server_whose_answers_differ_is_not_compared(tmp_path):
    rng = np.random.default_rng(0)
    with foreign_server(lambda *_: {"actions": rng.uniform(-1, 1, 2)}) as address:
        config = config_of(address, tmp_path)
        run_audit(config)
        run_audit(replace(config, episodes=2))
    assert json.loads((tmp_path / "out" / "policy.json").read_text())["answer"] is None


def test_another_seed_in_the_same_folder_is_refused(tmp_path):
    config = AuditConfig("tests.fakes:FakePolicy", tmp_path, **OPTIONS)
    run_audit(config)
    for name in ("policy.json", "audit.json"):  # The second one as an older version left it.
        with pytest.raises(UserError, match="--seed 60000 with which .* found 70000; choose anoth"):
            run_audit(replace(config, seed=70_000))
        (tmp_path / name).unlink()
    run_audit(replace(config, seed=70_000))


VERSIONS = ["one"]


def versioned() -> FakePolicy:
    policy = FakePolicy()
    policy.spec = replace(policy.spec, digest=VERSIONS[-1])
    return policy


def test_other_weights_are_refused_also_after_an_audit_that_was_stopped(tmp_path, monkeypatch):
    config = AuditConfig("tests.test_audited_policy:versioned", tmp_path, **OPTIONS)
    run_audit(config)
    (tmp_path / "audit.json").unlink()
    monkeypatch.setattr("tests.test_audited_policy.VERSIONS", ["two"])
    with pytest.raises(UserError, match="with the digest one with which .* found two"):
        run_audit(config)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_another_policy_in_the_middle_of_an_evaluation_is_refused(protocol, tmp_path):
    says = {"model": "one"}
    looks = 0

    def answer(look: dict[str, Any], connection: object) -> dict[str, Any]:
        nonlocal looks
        looks += 1
        says["model"] = "one" if looks < 30 else "two"
        return {"actions": np.zeros(2)}

    with foreign_server(answer, protocol, says) as address:
        reference = with_wire(address, wiring_file(tmp_path, history="true"))
        with pytest.raises(
            Unfinished, match="'one'}, found {'model': 'two'}; another one is serve"
        ):
            evaluate(reference, ["all"], episodes=4, workers=0)


def test_what_a_server_says_is_in_the_digest(tmp_path):
    digests = set()
    says: dict[str, Any] = {}
    with foreign_server(towards_bright, says=says) as address:
        for model in ("one", "two"):
            says["model"] = model
            digests.add(load_policy(with_wire(address, wiring_file(tmp_path))).spec.digest)
    assert len(digests) == 2
