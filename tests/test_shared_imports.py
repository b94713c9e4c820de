"""What simulations share: imported once, before they are forked."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from madviz.app import server
from madviz.app.server import ExploreConfig, open_app
from madviz.envs.registry import shared_imports


def test_a_task_names_modules_that_are_there_and_another_none() -> None:
    assert all(map(find_spec, shared_imports("maniskill/push-cube")))
    assert shared_imports("maniskill/push-cube")
    assert shared_imports("metaworld/hammer") == shared_imports("mine:make") == ()


class Prepared(Exception):
    """The fork server would start now."""


@pytest.mark.parametrize("task", ["maniskill/push-cube", "metaworld/hammer"])
def test_the_fork_server_imports_the_simulator_of_the_first_policy(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def prepare(*modules: str) -> None:
        raise Prepared(*modules)

    monkeypatch.setattr(server, "prepare", prepare)
    with pytest.raises(Prepared) as started:
        open_app(ExploreConfig(policy=f"{task.replace('/', '-')}-mad-light", workers=0))
    assert started.value.args == ("madviz.app.session_maker", *shared_imports(task))
