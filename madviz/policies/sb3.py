"""``--policy sb3:model.zip``: a policy of Stable-Baselines3, which was trained on madviz's tasks.

Its file holds Python objects (cloudpickle): whoever loads it runs what is in it. So it is loaded
only when the user says that they trust it, with ``--trust`` or MADVIZ_TRUST=FILE; a name that comes
from a page or from a file is not trusted.

What it was trained on is read from its own spaces, those of ``gymnasium.make("madviz/hammer-v0",
flat=True)``: pictures by camera, ``first_depth`` in metres, and ``agent_pos``. Which task it was,
the file does not say: ``sb3:model.zip@metaworld/hammer``. The statistics of VecNormalize are in a
file of their own, which is trusted with it: ``sb3:model.zip+statistics.pkl@metaworld/hammer``.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from madviz.envs.registry import env_spec
from madviz.errors import UserError
from madviz.policies.sb3_policy import STATE, Sb3Policy, policy_on

PREFIX = "sb3:"
AT = "@"
PLUS = ".zip+"
VARIABLE = "MADVIZ_TRUST"
MOST_UNSEEN = 0.01
"""A state that changed by more has moved something that the pictures show."""
NEEDED = ("policy_class", "policy_kwargs", "observation_space", "action_space")


def is_sb3(policy: str) -> bool:
    """Whether the name means a file of Stable-Baselines3."""
    return policy.startswith(PREFIX)


def trust(policy: str | None, on: bool) -> None:
    """Makes the files of ``policy`` trusted in this process and all that it starts, if ``on``."""
    if policy is not None and on and is_sb3(policy):
        file, statistics, _ = _parts(policy)
        files = [str(each.resolve()) for each in (file, statistics) if each is not None]
        os.environ[VARIABLE] = os.pathsep.join([*_trusted(), *files])


def shown_sb3(policy: str) -> str:
    """``policy`` as it may be shown to others: of a file's path the last part only."""
    file, statistics, task = _parts(policy)
    added = f"+{statistics.name}" if statistics else ""
    return f"{PREFIX}{file.name}{added}" + (f"{AT}{task}" if task else "")


def load_sb3(policy: str) -> Sb3Policy:
    """The policy ``sb3:FILE@TASK``. Raises UserError for a file that is not trusted, cannot be
    loaded, or was trained on something else than the task's pictures, state and actions."""
    file, statistics, task = _parts(policy)
    file = file.resolve()
    for each in (file, statistics):
        if each is not None and str(each.resolve()) not in _trusted():
            raise UserError(
                f"{each.resolve()}: a file of Stable-Baselines3 runs code when it is loaded, and "
                "this one is not trusted yet; if you trust its source, add --trust, or set "
                f"{VARIABLE} to this path"
            )
    if not task:
        raise UserError(f"expected {PREFIX}FILE{AT}TASK, found no task; add {AT}metaworld/hammer")
    data, weights = _opened(file)
    if statistics is None and _was_normalised(data):
        raise UserError(
            f"{file}: was trained under VecNormalize, whose statistics are not in the file; save "
            f"them with VecNormalize.save and name them: {PREFIX}FILE{PLUS}STATISTICS.pkl{AT}TASK"
        )
    network = _network(file, data, weights)
    table = None if statistics is None else _statistics(statistics.resolve())
    read = file.read_bytes() + (statistics.read_bytes() if statistics else b"")
    digest = hashlib.sha256(read).hexdigest()
    return policy_on(env_spec(task), network, table, file, digest)


def _opened(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The facts of a model as Stable-Baselines3 wrote them, and its weights. Raises UserError."""
    try:
        from stable_baselines3.common.save_util import load_from_zip_file
    except ImportError as error:
        raise UserError(
            "expected Stable-Baselines3, found none here; pip install 'madviz[sb3]'"
        ) from error
    try:
        with warnings.catch_warnings(record=True) as unread:
            warnings.simplefilter("always")
            data, weights, _ = load_from_zip_file(str(file), device="cpu")
    except Exception as error:  # Foreign objects may raise anything.
        raise _broken(file, error) from error
    for key in NEEDED:
        if key not in (data or {}):
            reasons = [
                str(each.message) for each in unread if f"object {key}." in str(each.message)
            ]
            reason = " ".join(reasons).rpartition("Exception: ")[2] or "nothing of it"
            raise _broken(file, ValueError(f"{key} cannot be read: {reason}"))
    assert data is not None
    return data, weights


def _network(file: Path, data: dict[str, Any], weights: dict[str, Any]) -> Any:
    """The policy of Stable-Baselines3 with its weights. Raises UserError."""
    options = {key: each for key, each in data["policy_kwargs"].items() if key != "device"}
    if data.get("use_sde"):
        options["use_sde"] = True
    try:
        network = data["policy_class"](
            data["observation_space"], data["action_space"], lambda _: 0.0, **options
        )
        network.load_state_dict(weights["policy"])
    except Exception as error:  # A class of the user's own may raise anything.
        raise _broken(file, error) from error
    if hasattr(network, "lstm_actor"):
        raise UserError(f"{file}: expected a policy without a recurrent state, found one with LSTM")
    return network


def _statistics(file: Path) -> Any:
    """The VecNormalize of a file. Raises UserError."""
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        table = pickle.loads(file.read_bytes())
    except Exception as error:  # A pickle may raise anything.
        raise UserError(f"{file}: expected statistics of VecNormalize, found: {error}") from error
    if not isinstance(table, VecNormalize) or not isinstance(getattr(table, "obs_rms", {}), dict):
        raise UserError(
            f"{file}: expected statistics of VecNormalize, found {type(table).__name__}"
        )
    return table


def _was_normalised(data: dict[str, Any]) -> bool:
    """Whether a model says that it was trained under VecNormalize. An on-policy model keeps raw
    observations only then. An off-policy model always keeps them: under VecNormalize those of the
    last observation, whose pictures are then the same and whose state is not; without it those of
    the decision before."""
    raw = data.get("_last_original_obs")
    seen = data.get("_last_obs")
    if "gae_lambda" in data or not isinstance(raw, dict) or not isinstance(seen, dict):
        return "gae_lambda" in data and raw is not None
    same = {key: np.array_equal(raw[key], seen[key]) for key in raw.keys() & seen.keys()}
    apart = np.abs(raw.get(STATE, 0.0) - seen.get(STATE, 0.0)).max()
    same.pop(STATE, None)
    return bool(apart > MOST_UNSEEN and same and all(same.values()))


def _broken(file: Path, error: Exception) -> UserError:
    if isinstance(error, ImportError):
        module = (error.name or str(error)).partition(".")[0]
        return UserError(
            f"{file}: needs the Python module {module}, which is not found here; set PYTHONPATH to "
            f"the folder with {module}.py, or install it"
        )
    reason = " ".join(str(error).split()) or type(error).__name__
    return UserError(f"{file}: expected a policy of Stable-Baselines3, found: {reason:.200}")


def _parts(policy: str) -> tuple[Path, Path | None, str]:
    """File, file of statistics, and task, '' where there is none. A folder of the file may have an
    @ in its name. As Stable-Baselines3 does, a name without .zip is taken for the file with it."""
    words = policy.removeprefix(PREFIX)
    files, _, task = words.rpartition(AT) if AT in words else (words, "", "")
    file, plus, statistics = files.partition(PLUS)
    whole = plus or (not Path(file).is_file() and Path(f"{file}.zip").is_file())
    return Path(f"{file}.zip" if whole else file), Path(statistics) if plus else None, task


def _trusted() -> list[str]:
    return [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]
