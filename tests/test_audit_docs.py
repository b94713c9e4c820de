"""The policy in docs/audit.md is one, and its audit says what the page says."""

import json
import re
import textwrap
from pathlib import Path

from madviz.measure.audit.audit import audit
from madviz.measure.audit.sentences import in_words
from madviz.types import Policy

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "audit.md"


def test_the_policy_in_the_docs_is_audited_as_the_docs_say():
    (code,) = re.findall(r"^    ```python\n(.*?)^    ```", PAGE.read_text(), re.M | re.S)
    names: dict = {}
    exec(textwrap.dedent(code), names)
    policy = names["make"]()
    assert isinstance(policy, Policy)
    found = audit(policy, episodes=16, how=())
    assert found["verdict"] == {
        "first": "no use shown",
        "third_a": "no use shown",
        "third_b": "needed",
    }
    assert found["decided_by"]["first"] == {"removed": "mean", "alone": "mean"}
    assert "Third B is needed, and of the other two no use is shown" in PAGE.read_text()


def test_the_audits_in_the_docs_are_those_in_the_files() -> None:
    files = sorted((ROOT / "results" / "audits").glob("*.json"))
    assert len(files) >= 2
    for file in files:
        for line in in_words(json.loads(file.read_text())):
            assert f"- {line}\n" in PAGE.read_text()
