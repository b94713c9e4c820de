"""Policy folders: everything needed to act, in files a person can read or a card can be made from.

    config.json          what it is: task, streams, networks, how it was trained   (config.py)
    weights.safetensors  encoder, actor and critic, half precision                 (this file)
    evaluation.json      what ``madviz eval --card`` measured                      (evaluate.py)
    curve.csv            success and losses while it was trained                   (train.py)
    origin.json          how it was chosen, or by which script taught, if that counts (origin.py)
    card.md              generated from the JSON files                             (card.py)

Loading needs nothing else, runs no code from the folder (no pickle), and is strict: a tensor that
is missing, foreign, misshapen or not finite is an error in one line. Weights are stored in half
precision and computed with in float32: 7.6 MB for the paper's networks, 3 MB for the light ones.

The *digest* is the SHA-256 of the weights file and of the config in canonical JSON. It names the
policy in the store of results: whoever changes either file starts from zero episodes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from madviz.agent.merges.merge_table import MERGES
from madviz.agent.sizes import NetworkConfig
from madviz.envs.custom import allow_task
from madviz.errors import UserError, perhaps
from madviz.guard.policy import GuardedPolicy
from madviz.guard.values import FILE, read_values
from madviz.policies.config import (
    PolicyConfig,
    check_config,
    digest,
    networks_of,
    read_config,
)
from madviz.policies.guarded import fit_command, is_guarded, unguarded
from madviz.policies.measured import EvaluationFile, as_evaluation
from madviz.policies.no_policy import NoPolicy, is_no_policy
from madviz.policies.sb3 import is_sb3, load_sb3, shown_sb3
from madviz.recorded.known import is_recording
from madviz.recorded.robot import Robot, read_robot
from madviz.system.collection import imported
from madviz.system.files import read_json, write_bytes, write_json
from madviz.system.options import Listed
from madviz.system.plugins import made_by
from madviz.types import Policy, PolicySpec
from madviz.wire.reference import connect, is_served, plain

if TYPE_CHECKING:
    from torch import Tensor

    from madviz.agent.agent import Agent

CONFIG = "config.json"
WEIGHTS = "weights.safetensors"
EVALUATION = "evaluation.json"
DEVELOPMENT = "development.json"
"""As evaluation.json, on other seeds (seeds.py), once that holds reporting seeds."""
CARD = "card.md"
IN_RUN = "policy"
"""The name of the policy's folder inside the folder of a sweep's run."""


@dataclass(frozen=True)
class PolicyFolder:
    """A policy that was found and whose config was checked; its weights are not loaded."""

    path: Path
    config: PolicyConfig
    spec: PolicySpec


# --- Writing --------------------------------------------------------------------------------


def save_policy(
    folder: str | Path, agent: Agent, config: PolicyConfig, *, half: bool = True
) -> Path:
    """Writes config and weights of ``agent``, each file whole or not at all; returns the folder.

    Raises UserError for weights that are not finite (training diverged) and for a bad config.
    """
    from safetensors.torch import save

    folder = Path(folder)
    document = check_config(config, folder / CONFIG)
    tensors = {}
    for name, tensor in agent.acting_state().items():
        tensor = tensor.detach().cpu()
        tensors[name] = (tensor.half() if half else tensor.float()).contiguous()
        if not tensors[name].isfinite().all():
            raise UserError(
                f"expected finite weights, found NaN or infinity in {name}; the training diverged: "
                "begin again with a smaller learning rate"
            )
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / WEIGHTS, save(tensors))
    write_json(folder / CONFIG, document)
    return folder


# --- Reading --------------------------------------------------------------------------------


def policy_roots() -> list[Path]:
    """Where names are looked up: $MADVIZ_CHECKPOINTS, ./checkpoints, the repository's, and the two
    policies that an installed package brings."""
    named = [Path(p) for p in os.environ.get("MADVIZ_CHECKPOINTS", "").split(os.pathsep) if p]
    package = Path(__file__).resolve().parents[1]
    shipped = [package.parent / "checkpoints", package / "bundled"]
    return list(dict.fromkeys([*named, Path.cwd() / "checkpoints", *shipped]))


def results_beside(root: Path) -> Path:
    """The folder beside ``root`` with what was measured: tables/ holds policies without weights."""
    return root.parent / "results"


def policy_folders() -> dict[str, Path]:
    """Every policy under the roots by name; the first root that has a name wins."""
    return _by_name(policy_roots())


PolicyName = Annotated[str, Listed("policies", policy_folders)]
"""An option: a name of a policy, its folder, module:factory, or an address."""


def measured_folders() -> dict[str, Path]:
    """Policies of which only the measured figures are here, no weights; by name."""
    tables = [results_beside(root) / "tables" for root in policy_roots()]
    folders = _by_name(list(dict.fromkeys(tables)))
    return {name: path for name, path in folders.items() if not (path / WEIGHTS).is_file()}


def _by_name(roots: Sequence[Path]) -> dict[str, Path]:
    folders: dict[str, Path] = {}
    for root in roots:
        for config in sorted(root.glob(f"*/{CONFIG}")):
            folders.setdefault(config.parent.name, config.parent)
    return folders


def find_policy(policy: str | Path) -> Path:
    """The folder of a policy, given by path or name. Raises UserError listing the known names."""
    if os.path.isfile(Path(policy) / CONFIG):  # Also for names that no file can have.
        return Path(policy)
    known = policy_folders()
    for folders in (known, measured_folders()):
        if str(policy) in folders:
            return folders[str(policy)]
    raise UserError(
        f"unknown policy {str(policy)!r:.100}{perhaps(str(policy), list(known)) or ':'} expected "
        f"a folder with {CONFIG}, module:factory, "
        f"or one of: {', '.join(known) or 'none found; see `madviz train`'}"
    )


def describe(policy: str | Path) -> PolicyFolder:
    """Finds and checks a policy without loading its weights (or torch)."""
    path = find_policy(policy)
    config, text = read_config(path / CONFIG)
    stat = _existing(path / WEIGHTS).stat()
    weights = _sha256(path / WEIGHTS, stat.st_mtime_ns, stat.st_size)
    return PolicyFolder(path, config, config.spec(digest(weights, text)))


def is_folder(policy: str | Path) -> bool:
    """Whether ``policy`` is a path or a name, and not ``module:factory`` or nothing at all."""
    return bool(str(policy)) and (":" not in str(policy) or os.path.exists(policy))


def shown(policy: str) -> str:
    """The reference ``policy`` as it may be shown to others: no secret, and of paths the last part
    alone."""
    return shown_sb3(policy) if is_sb3(policy) else plain(policy)


def load_policy(policy: str | Path) -> Policy:
    """A policy that can act: from a folder, a name (see ``policy_roots``), ``module:factory``, or
    ``ws://host:port`` of one that is served (``madviz.wire.reference``), or ``sb3:FILE@TASK`` of
    Stable-Baselines3, if that was trusted (``sb3.py``). ``guard:`` before a folder or a name adds a
    guard (``guarded.py``). ``recorded:NAME`` is none (``no_policy.py``).

    Raises UserError for anything but a complete, finite policy of a known format.
    """
    if is_guarded(str(policy)):
        return _guarded(unguarded(str(policy)))
    if is_served(str(policy)):
        return connect(str(policy))
    if is_sb3(str(policy)):
        return load_sb3(str(policy))
    if is_no_policy(str(policy)):
        return NoPolicy(str(policy))
    if not is_folder(policy):
        return _from_factory(str(policy))
    path = find_policy(policy)
    config, text = read_config(path / CONFIG)
    weights = _existing(path / WEIGHTS).read_bytes()

    imported("madviz.agent.agent")  # With torch.
    from madviz.agent.agent import TorchPolicy

    if config.merge not in MERGES:
        raise UserError(f"{path / CONFIG}: unknown merge {config.merge!r}; known: {list(MERGES)}")
    networks = networks_of(config, text, path / CONFIG)
    agent = _agent(path, config, networks, weights)
    spec = config.spec(digest(hashlib.sha256(weights).hexdigest(), text))
    # A critic that has learned nothing, for want of rewards or of updates: its Q is not shown.
    untaught = is_recording(config.task) or config.training.critic_updates == 0
    scale = nan if untaught else config.reward_scale
    return TorchPolicy(spec, agent, scale)


def has_guard(policy: str) -> bool:
    """True where the policy is a folder with fitted values of a guard."""
    with suppress(UserError):
        return is_folder(policy) and (find_policy(policy) / FILE).is_file()
    return False


def robot_of_policy(policy: str) -> Robot | None:
    """The robot whose recordings the policy of a folder or a name learned from; None for others.
    Raises UserError for a policy of recordings without its robot.json."""
    if not is_folder(unguarded(policy)):
        return None
    path = find_policy(unguarded(policy))
    return read_robot(path) if is_recording(read_config(path / CONFIG)[0].task) else None


def _guarded(policy: str) -> GuardedPolicy:
    if not is_folder(policy):
        raise UserError(
            f"expected a policy folder with {FILE} beside a guard, found {policy!r:.100}; in "
            "Python, wrap it: madviz.guard.policy.GuardedPolicy(policy, values)"
        )
    folder = describe(policy)
    values = read_values(folder.path / FILE, fit_command(policy, folder.config.task))
    return GuardedPolicy(load_policy(policy), values)


def _agent(path: Path, config: PolicyConfig, networks: NetworkConfig, weights: bytes) -> Agent:
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load

    from madviz.agent.agent import Agent

    try:
        # Without memory at first: shapes are known before anything is initialised or allocated.
        with torch.device("meta"):
            agent = Agent(networks, merge=config.merge, streams=config.streams)
    except (ValueError, RuntimeError) as error:
        raise UserError(f"{path / CONFIG}: networks that cannot be built: {error}") from error
    try:
        tensors = load(weights)
    except SafetensorError as error:
        raise UserError(
            f"{path / WEIGHTS}: expected a safetensors file, found {len(weights)} bytes that are "
            f"none ({error}); it is truncated or something else: restore it or retrain"
        ) from error
    _check_tensors(path / WEIGHTS, tensors, agent.acting_state())
    # Assigned, as torch's own to_empty would import sympy: 0.3 s and 35 MB for every process.
    state = {
        name: torch.empty_strided(planned.shape, planned.stride(), dtype=planned.dtype)
        for name, planned in agent.state_dict().items()  # Some are channels last.
    }
    agent.load_state_dict(state, assign=True)
    agent.load_state_dict(tensors, strict=False)
    agent.target.load_state_dict(agent.critic.state_dict())
    torch.nn.init.zeros_(agent.log_temperature)
    return agent


def _check_tensors(
    where: Path, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]
) -> None:
    missing = sorted(expected.keys() - found.keys())
    extra = sorted(found.keys() - expected.keys())
    if missing or extra:
        raise UserError(
            f"{where}: expected {len(expected)} tensors of a policy, found {len(found)} "
            f"(missing: {', '.join(missing[:3]) or 'none'}; extra: {', '.join(extra[:3]) or 'none'}"
            "); it belongs to another config.json or program: restore it or retrain"
        )
    for name, tensor in found.items():
        if tensor.shape != expected[name].shape:
            raise UserError(
                f"{where}: expected {name} of shape {tuple(expected[name].shape)}, found "
                f"{tuple(tensor.shape)}; it belongs to another config.json: restore it or retrain"
            )
        if not tensor.isfinite().all():
            raise UserError(
                f"{where}: expected finite weights, found NaN or infinity in {name}; "
                "the training diverged or the file is damaged: restore it or retrain"
            )


def _from_factory(policy: str) -> Policy:
    made = made_by(policy, Policy)
    allow_task(made.spec.task)  # Whoever named the policy's code names its task.
    return made


def shipped_evaluation(policy: str | Path, name: str = EVALUATION) -> EvaluationFile | None:
    """The file ``name`` of a policy folder; None if there is none or it measured other weights.
    Raises UserError for a file that is no evaluation."""
    folder = describe(policy)
    file = folder.path / name
    if not file.is_file():
        return None
    document = read_json(file)
    measured = document.get("digest") if isinstance(document, dict) else None
    if isinstance(measured, str) and measured != folder.spec.digest:
        return None
    return as_evaluation(document, file)


def own_evaluation(folder: PolicyFolder, name: str = EVALUATION) -> EvaluationFile:
    """The file ``name`` of a policy folder. Raises UserError if there is none, or if it measured
    other weights."""
    file = folder.path / name
    if not file.is_file():
        raise UserError(
            f"{file}: expected an evaluation, found no such file; run "
            f"`madviz eval --policy {folder.path} --card`"
        )
    evaluation = as_evaluation(read_json(file), file)
    if evaluation["digest"] != folder.spec.digest:
        raise UserError(
            f"{file}: expected an evaluation of these weights, found one of others; "
            f"run `madviz eval --policy {folder.path} --card`"
        )
    return evaluation


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise UserError(
            f"{path}: expected the policy's weights, found no such file; restore it, or train the "
            f"policy again with the command in {CARD}"
        )
    return path


@lru_cache(maxsize=64)
def _sha256(path: Path, modified_ns: int, size: int) -> str:
    """Hash of a file; the last two arguments make a changed file a new question."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
