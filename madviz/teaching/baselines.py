"""For lesson 6: a baseline as small as lesson 3 trains MAD, measured with cameras missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from madviz.errors import UserError
from madviz.measure.evaluate import evaluate
from madviz.measure.evidence import find_evidence
from madviz.observation.ablation import Occlusion
from madviz.policies import checkpoint
from madviz.policies.seeds import FIRST_DEVELOPMENT
from madviz.report.layouts import BASELINES
from madviz.report.tables import build
from madviz.subsets import mask_of
from madviz.teaching import SmallRun, train_small
from madviz.teaching.outcomes import EPISODES, ROUNDS, UPDATES, cases
from madviz.types import Policy


def train_baseline(name: str) -> SmallRun:
    """The small training of one method: ``single`` learns from Third A, the others from all."""
    camera = "third_a" if name == "single" else ""
    return train_small(name, camera=camera, rounds=ROUNDS, updates=UPDATES)


def run_cases(
    policy: Policy,
    names: Sequence[str] = (),
    episodes: int = EPISODES,
    seed: int = FIRST_DEVELOPMENT,
) -> dict[str, str]:
    """Case -> outcomes of those called ``names`` (all of them if there are none), run in this
    process. A camera that the policy never had changes nothing, and nothing is run twice."""
    known = cases()
    found: dict[str, str] = {}
    ran: dict[tuple[str, str], str] = {}
    for name in names or known:
        cameras, black = known[name]
        left = [camera for camera in cameras if camera in policy.spec.streams]
        subset = "+".join(left)
        black = black if black in left else ""
        if not left or not policy.supports(mask_of(subset, policy.spec.streams)):
            continue
        if (subset, black) not in ran:
            occlusions = {black: Occlusion("black")} if black else {}
            result = evaluate(
                policy, [subset], episodes=episodes, seed=seed, workers=0, occlusions=occlusions
            )
            ran[subset, black] = "".join(str(int(one.success)) for one in result.episodes)
        found[name] = ran[subset, black]
    return found


def on_robot(task: str) -> dict[str, dict[str, str]]:
    """Method -> outcomes with all cameras and with each alone, of the trainings of ``task`` that
    were measured before and are comparable: one recipe, one budget, the same seeds, and where some
    methods were trained more often, the trainings that all have. Single Camera is a training per
    camera and has none with all. Raises UserError where none are found."""
    layout = replace(BASELINES, needs=2)
    for root in checkpoint.policy_roots():
        evidence, _ = find_evidence(root, checkpoint.results_beside(root))
        for found in build(layout, [each for each in evidence if each.config.task == task]):
            rows = [row for _, row in found.rows]
            shared = set.intersection(*(row.training_seeds for row in rows))
            return {
                row.label: {
                    column: "".join(str(int(success)) for _, success in sorted(cell.items()))
                    for column, cell in row.seeded(shared).cells.items()
                }
                for row in rows
            }
    raise UserError(
        f"expected the repository's results for {task}, found none; run this in a clone of it, or "
        "name its policies: MADVIZ_CHECKPOINTS=CLONE/checkpoints"
    )
