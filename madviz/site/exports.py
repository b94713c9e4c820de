"""The tasks and policies of a site, as files and as lines of its manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from madviz.agent.methods import label_of
from madviz.envs.metaworld.environment import MetaWorld
from madviz.envs.registry import make_env
from madviz.envs.tasks import done_words
from madviz.errors import UserError
from madviz.guard.values import FILE
from madviz.policies.checkpoint import PolicyFolder, load_policy, shipped_evaluation
from madviz.policies.guarded import with_guard
from madviz.policies.measured import seeds_of
from madviz.site.drawn_scene import drawn_scene, scene_file
from madviz.site.files import write_packed, write_shared
from madviz.site.graph import policy_graph
from madviz.site.mjcf import model_text
from madviz.site.starts import start_states


def export_task(out: Path, task: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Model, scene, textures and start states of ``task``; its line of the manifest. Raises
    UserError for a task of another suite than Meta-World."""
    env = make_env(task)
    if not isinstance(env, MetaWorld):
        raise UserError(f"expected a task of Meta-World, found {task}; others are only recorded")
    try:
        starts = start_states(env, seeds)
        simulation = env.simulation
        arrays, description, textures = drawn_scene(simulation.model, simulation.data)
        folder = f"tasks/{task.replace('/', '-')}"
        return {
            "name": task,
            "label": task.partition("/")[2].replace("-", " ").capitalize(),
            "success": env.spec.success,
            "done": done_words(task),
            "horizon": env.spec.horizon,
            "action_repeat": env.spec.action_repeat,
            "reach": [simulation.mocap_low.tolist(), simulation.mocap_high.tolist()],
            "seeds": list(seeds),
            "model": write_packed(out, f"{folder}/model.gz", model_text(simulation.model).encode()),
            "scene": write_packed(out, f"{folder}/scene.gz", scene_file(arrays, description)),
            "textures": [write_shared(out, "textures", texture.arrays()) for texture in textures],
            "starts": write_packed(out, f"{folder}/starts.gz", save(starts)),
        }
    finally:
        env.close()


def export_policy(out: Path, folder: PolicyFolder, label: str) -> dict[str, Any]:
    """The graph of a policy, and the values of its guard; its line of the manifest."""
    policy = load_policy(folder.path)
    spec = folder.spec
    line = {
        **description_of(folder, label),
        "state_dim": spec.state_dim,
        "graph": write_packed(out, f"policies/{spec.name}.gz", policy_graph(policy)),
    }
    values = folder.path / FILE
    if values.is_file():
        guarded = load_policy(with_guard(str(folder.path), True))
        line["guard"] = write_packed(out, f"policies/{spec.name}-guard.gz", values.read_bytes())
        line["guarded_digest"] = guarded.spec.digest
    return line


def labels_of(folders: Sequence[PolicyFolder]) -> dict[str, str]:
    """By name, the label of each policy; with its recipe where another of its task has that
    label."""
    specs = {folder.spec.name: folder.spec for folder in folders}
    often = Counter((spec.task, label_of(spec)) for spec in specs.values())
    return {
        name: label_of(spec) + (f", {spec.recipe}" if often[spec.task, label_of(spec)] > 1 else "")
        for name, spec in specs.items()
    }


def description_of(folder: PolicyFolder, label: str) -> dict[str, Any]:
    """Name, label, streams, cameras and measured success of a policy."""
    spec = folder.spec
    evaluation = shipped_evaluation(folder.path)
    return {
        "name": spec.name,
        "label": label,
        "task": spec.task,
        "method": spec.method,
        "setting": spec.setting,
        "recipe": spec.recipe,
        "streams": list(spec.streams),
        "trained_subsets": list(spec.trained_subsets),
        "digest": spec.digest,
        "cameras": [asdict(camera) for camera in spec.cameras],
        "measured": dict(evaluation["subsets"]) if evaluation else {},
        "seeds": f"{seeds_of(evaluation)} seeds" if evaluation else "",
    }
