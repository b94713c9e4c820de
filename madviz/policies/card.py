"""card.md of a policy folder: generated from config.json, evaluation.json and, where there is one,
origin.json; never typed by hand.

A card is shown beside the weights by every code host, so it says first what a reader needs: what
the policy does, from which cameras it was trained to do it, and how often it succeeds, with
interval, episode count, definition and seeds. A test can hold a committed card against
``card_text``.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from madviz.policies import checkpoint
from madviz.policies.again import command_again
from madviz.policies.config import PolicyConfig, TrainingRecord
from madviz.policies.measured import EvaluationFile, SubsetRow, seeds_of
from madviz.policies.origin import ORIGIN, Origin, origin_of
from madviz.policies.seeds import MEASURED
from madviz.recorded.known import LABEL, is_recording
from madviz.recorded.robot import FILE as ROBOT
from madviz.recorded.robot import read_robot
from madviz.system.files import write_bytes
from madviz.system.markdown import markdown_table
from madviz.types import CameraSpec


def write_card(folder: str | Path) -> Path:
    """Writes card.md; returns its path. Raises UserError for an evaluation of other weights."""
    path = Path(folder) / checkpoint.CARD
    write_bytes(path, card_text(folder).encode())
    return path


def card_text(folder: str | Path) -> str:
    """The text of card.md for ``folder``."""
    policy = checkpoint.describe(folder)
    measured = (policy.path / checkpoint.EVALUATION).is_file()
    evaluation = checkpoint.own_evaluation(policy) if measured else None
    origin = origin_of(policy.path)
    sections = [
        _head(policy.config, _reference(policy)),
        _success(evaluation, _reference(policy), policy.config.task),
        _inputs(policy.config, policy.path),
        _training(policy.config.training, policy.path.resolve().name, origin),
        f"Digest of weights and config: `{policy.spec.digest}`.",
        _source(policy.config.task, origin),
    ]
    return "\n\n".join(sections) + "\n"


def _reference(policy: checkpoint.PolicyFolder) -> str:
    """The name that opens these very files: an included policy's own, else the folder's, from where
    that one is."""
    path = policy.path.resolve()
    known = checkpoint.policy_folders().get(policy.config.name)
    return policy.config.name if known and known.resolve() == path else path.name


def _head(config: PolicyConfig, name: str) -> str:
    recorded = is_recording(config.task)
    source = f" --recording {config.task.partition('/')[2]}" if recorded else ""
    return (
        f"# {config.name}\n\n"
        f"Task `{config.task}`, method `{config.method}`, setting `{config.setting}`, "
        f"recipe `{config.recipe}`.\n\n"
        f"    madviz explore{source} --policy {name}"
    )


def _success(evaluation: EvaluationFile | None, name: str, task: str) -> str:
    if is_recording(task):
        return (
            "## Success\n\nNot measured: it imitates recordings, and nothing was played. "
            "`curve.csv` has its distance from recorded actions in held-out episodes."
        )
    if evaluation is None:
        return f"## Success\n\nNot measured yet: `madviz eval --policy {name} --card`."
    header = ("present", "success", "95% interval", "any step", "episodes", "")
    rows = [_success_cells(subset, row) for subset, row in evaluation["subsets"].items()]
    lines = [
        "## Success",
        "",
        markdown_table(header, rows),
        "",
        f"A success, {evaluation['definition']}. {_seeds(evaluation)}; "
        f"render profile `{evaluation['render_profile']}`. "
        "Intervals are Wilson's. Rows not trained on this subset show what happens there; the "
        "training did not aim at it.",
    ]
    return "\n".join(lines)


def _seeds(evaluation: EvaluationFile) -> str:
    """The seeds of the rows. All begin with the same one; a row that was measured in another go may
    have more of them."""
    use = seeds_of(evaluation)
    first = evaluation["seed"]
    words = f"{use.capitalize()} seeds" if use in MEASURED else "Seeds"
    if len({row["n"] for row in evaluation["subsets"].values()}) > 1:
        return f"{words} from {first} on, in each row as many as it has episodes"
    last = max(episode["seed"] for episode in evaluation["episodes"])
    return f"{words} {first} to {last}, the same for every row"


def _success_cells(subset: str, row: SubsetRow) -> list[str]:
    low, high = row["ci95"]
    return [
        subset,
        f"{row['success']:.2f}",
        f"{low:.2f} – {high:.2f}",
        f"{row['success_any']:.2f}",
        str(row["n"]),
        "" if row["trained"] else "not trained on this subset",
    ]


def _source(task: str, origin: Origin | None) -> str:
    if is_recording(task):
        return f"Generated from `config.json` and `{ROBOT}` by `madviz train`; not edited."
    first = f"`config.json`, `{ORIGIN}`" if origin else "`config.json`"
    return f"Generated from {first} and `evaluation.json` by `madviz eval --card`; not edited."


def _inputs(config: PolicyConfig, folder: Path) -> str:
    networks = config.networks
    lines = [
        "## What it sees",
        "",
        f"Streams: {', '.join(config.streams)}. Trained to work from: "
        f"{', '.join(config.trained_subsets)}.",
        "",
        f"{config.image_size} × {config.image_size} pixels, {networks.frame_stack} frames "
        f"stacked; {networks.state_dim} proprioceptive numbers in, {networks.action_dim} "
        "action numbers out. ",
    ]
    if is_recording(config.task):
        robot = read_robot(folder)
        lines[-1] += f"{robot.fps:g} decisions a second, {LABEL}."
        cells = [(c.name, c.key, f"{c.height} × {c.width}") for c in robot.cameras]
        return "\n".join([*lines, "", markdown_table(("camera", "column", "pixels"), cells)])
    lines[-1] += (
        f"{config.horizon} decisions of {config.action_repeat} simulator "
        f"steps make an episode. Render profile `{config.render_profile}`."
    )
    heads = ("camera", "position, m", "orientation wxyz (OpenGL)", "field of view", "rides on")
    table = markdown_table(heads, map(_camera_cells, config.cameras))
    return "\n".join([*lines, "", table])


def _camera_cells(camera: CameraSpec) -> list[str]:
    return [
        camera.name,
        ", ".join(f"{value:g}" for value in camera.position),
        ", ".join(f"{value:.4g}" for value in camera.wxyz),
        f"{camera.fovy:g}°",
        camera.body or "nothing",
    ]


def _training(training: TrainingRecord, name: str, origin: Origin | None) -> str:
    """Whatever the recipe wrote down; the command first, alone on its line, to be copied."""
    lines = ["## How it was trained", ""]
    if training.command is not None:
        lines += [f"    {command_again(training, name)}", ""]
    for key, value in msgspec.to_builtins(training).items():
        if key != "command":
            lines.append(f"- {_title(key)}: {_plain(value)}")
    if origin and origin.choice:
        lines.append(f"- chosen: {origin.choice}")
    if origin and origin.script:
        lines.append(f"- script: {origin.script}")
    return "\n".join(lines)


def _title(name: str) -> str:
    """``wall_time_s`` -> ``wall time (s)``."""
    words = name.split("_")
    return " ".join(words[:-1]) + " (s)" if words[-1] == "s" else " ".join(words)


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{_title(key)} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return f"{value:,.4g}" if isinstance(value, float) else str(value)
