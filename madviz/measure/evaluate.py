"""Success rates: seeded episodes for every camera subset, counted at the last step.

    evaluation = madviz.evaluate("metaworld-hammer-mad-light", episodes=100, seed=5000)
    evaluation.rows["first"]      {"success": 0.91, "n": 100, "ci95": [0.84, 0.95], ...}

All subsets see the same seeds, so any two of them, and any two policies, can be compared episode by
episode (statistics.py). It computes and never repeats what a file claims; only a ``store`` that is
handed in answers for episodes it has seen. With workers or without, the results are the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from madviz.errors import Unfinished, UserError, saving, unknown
from madviz.guard.policy import guard_note
from madviz.measure.episodes import FIRST_SEED, clipped_words, unsupported
from madviz.measure.readings import note_reading
from madviz.measure.statistics import SuccessRate
from madviz.measure.store import EpisodeResult, Store
from madviz.measure.table import Table, seeds_of_run
from madviz.observation.ablation import Occlusion
from madviz.observation.condition import Condition
from madviz.observation.grammar import parse_occlusions
from madviz.policies import checkpoint
from madviz.policies.card import write_card
from madviz.policies.guarded import with_guard
from madviz.policies.measured import EpisodeRow, EvaluationFile, SubsetRow, seeds_of
from madviz.policies.sb3 import trust
from madviz.policies.seeds import DEVELOPMENT, READ, REPORTING
from madviz.subsets import cameras_of, mask_of, name_of, single_streams
from madviz.system.files import write_json, written_to
from madviz.system.numbers import Count, Seed, ThreadsOrNone
from madviz.system.streams import say
from madviz.types import Policy, PolicySpec
from madviz.wire.reference import with_wire


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one policy under one set of occlusions."""

    spec: PolicySpec
    definition: str
    seed: int
    occlusions: str
    """As in the store's key; '' where no camera is occluded."""
    episodes: tuple[EpisodeResult, ...]
    guard: str = ""
    """A sentence on the guard; '' without one."""

    @property
    def rows(self) -> dict[str, SubsetRow]:
        """Per subset: rates at the last and at any step, count, Wilson interval, trained or not."""
        table: dict[str, SubsetRow] = {}
        for subset in dict.fromkeys(e.subset for e in self.episodes):
            mine = [e for e in self.episodes if e.subset == subset]
            rate = SuccessRate.counted(e.success for e in mine)
            table[subset] = {
                "success": rate.value,
                "success_any": sum(e.success_any for e in mine) / len(mine),
                "n": rate.n,
                "ci95": list(rate.interval),
                "trained": subset in trained_names(self.spec),
                "outside": sum(e.outside for e in mine) / len(mine),
            }
        return table

    def outcomes(self, subset: str) -> dict[int, bool]:
        """Success by seed, for ``statistics.pair``."""
        return {e.seed: e.success for e in self.episodes if e.subset == subset}

    def to_json(self) -> EvaluationFile:
        """The document ``madviz eval --json`` writes."""
        episodes: list[EpisodeRow] = [
            {
                "subset": e.subset,
                "seed": e.seed,
                "success": e.success,
                "success_any": e.success_any,
                "return": e.total_reward,
            }
            for e in self.episodes
        ]
        document: EvaluationFile = {
            "schema": 1,
            "policy": self.spec.name,
            "digest": self.spec.digest,
            "task": self.spec.task,
            "definition": self.definition,
            "render_profile": self.spec.render_profile,
            "occlusions": self.occlusions,
            "seed": self.seed,
            "subsets": self.rows,
            "episodes": episodes,
        }
        return {**document, "guard": self.guard} if self.guard else document


def trained_names(spec: PolicySpec) -> tuple[str, ...]:
    """The trained subsets in their canonical spelling."""
    return tuple(name_of(mask_of(s, spec.streams), spec.streams) for s in spec.trained_subsets)


def default_subsets(spec: PolicySpec) -> tuple[str, ...]:
    """The subsets that say most about a policy: all streams, those it was trained on, every stream
    alone, and the floor (no camera at all, state only)."""
    return tuple(
        dict.fromkeys(["all", *trained_names(spec), *single_streams(spec.streams), "none"])
    )


def evaluate(
    policy: str | Path | Policy,
    subsets: Iterable[str] | None = None,
    *,
    episodes: int = 50,
    seed: int = FIRST_SEED,
    workers: int | None = None,
    occlusions: dict[str, Occlusion] | None = None,
    store: Store | None = None,
    progress: bool = False,
) -> Evaluation:
    """Runs the seeds ``seed`` to ``seed + episodes - 1`` on every one of ``subsets``.

    ``policy`` is a path, a name, ``module:factory``, or a policy itself, which then runs in this
    process. ``workers``: processes, by default one per core (a script needs ``if __name__ ==
    "__main__":`` around the call); 0 is none but this. ``store`` answers for episodes of policy
    folders that it has seen, and stores the new ones. Raises UserError for unknown names and for
    subsets the policy cannot act on, Unfinished with the Evaluation so far where something fails.
    """
    seeds = seeds_of_run(seed, episodes)
    table, loaded = Table.opened(policy, store)
    streams = loaded.spec.streams
    occluded = tuple(sorted((occlusions or {}).items()))
    for camera, _ in occluded:
        if camera not in cameras_of(streams):
            raise unknown("camera to occlude", camera, list(cameras_of(streams)))
    conditions = [
        Condition(subset, occluded).noticed(streams) for subset in _subsets(loaded, subsets)
    ]
    noticed = {camera for condition in conditions for camera, _ in condition.occlusions}
    for camera, occlusion in occluded:
        if camera not in noticed and occlusion.kind != "none":
            raise UserError(
                f"expected a subset with {camera!r}, which is occluded, found only "
                f"{' '.join(c.subset for c in conditions)!r:.100}; add one, or do not occlude it"
            )

    def so_far() -> Evaluation:
        known = [table.results(condition) for condition in conditions]
        return Evaluation(
            spec=loaded.spec,
            definition=table.definition,
            seed=seed,
            occlusions=Condition("all", occluded).noticed(streams).key(),
            episodes=tuple(results[s] for results in known for s in seeds if s in results),
            guard=guard_note(loaded),
        )

    try:
        table.play([(c, s) for c in conditions for s in seeds], workers, progress)
    except Exception as error:  # A policy of the user's may raise anything.
        done = so_far()
        if not done.episodes:
            raise
        count = len(conditions) * episodes
        why = error if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        raise Unfinished(
            f"{why}; {len(done.episodes)} of {count} episodes are done", done
        ) from error
    return so_far()


def _subsets(policy: Policy, subsets: Iterable[str] | None) -> tuple[str, ...]:
    """Subset names in canonical spelling, each once. Those asked for must be supported; of the
    default ones only the supported are taken."""
    streams = policy.spec.streams
    masks = [mask_of(name, streams) for name in subsets or default_subsets(policy.spec)]
    if not subsets:
        cannot = [name_of(mask, streams) for mask in masks if not policy.supports(mask)]
        masks = [mask for mask in masks if policy.supports(mask)]
        if cannot:
            say(f"{policy.spec.name} cannot act on {', '.join(dict.fromkeys(cannot))}: left out")
    for mask in masks:
        if not policy.supports(mask):
            raise unsupported(policy.spec, mask)
    return tuple(dict.fromkeys(name_of(mask, streams) for mask in masks))


# --- The command ----------------------------------------------------------------------------


@dataclass(frozen=True)
class EvalConfig:
    """Counts a policy's successes under camera subsets, on seeded episodes."""

    policy: checkpoint.PolicyName
    """A name of a policy, its folder, module:factory, or ws://HOST:PORT of one that is served."""
    subsets: tuple[str, ...] = ()
    """For example ``all first first+third_b none``; by default all, the trained ones, every
    stream alone, and none."""
    episodes: Count = 50
    """Episodes for each subset."""
    seed: Seed = FIRST_SEED
    """The first episode's seed; the others count up, the same for every subset."""
    workers: ThreadsOrNone | None = None
    """Processes; by default one per core. 0 runs everything in this one."""
    occlude: tuple[str, ...] = ()
    """Cameras that fail, for example ``first=black third_a=noise:0.5`` or, with its middle, width
    and height, ``third_b=patch:1:0.5:0.8:1:0.4``."""
    json: str | None = None
    """Where to write the result; - is standard output."""
    card: bool = False
    """Also write evaluation.json and card.md into the policy's folder. Subsets that were measured
    there before from the same first seed, and are not now, stay; those from another give way."""
    wire: Path | None = None
    """How a served policy's names and shapes map to ours, a TOML file; madviz serve says it
    itself."""
    guard: bool = False
    """A camera that the guard finds failing is left out until it works again; `madviz
    guard` fits it."""
    trust: bool = False
    """Whether the file of sb3:FILE@TASK may be loaded, which runs what is in it."""


def run_eval(config: EvalConfig) -> EvaluationFile:
    """``madviz eval``: always computes; progress goes to standard error."""
    other = config.occlude or config.guard
    if config.card and (other or not checkpoint.is_folder(config.policy)):
        raise UserError(
            "a card is about a policy folder's intact cameras: drop --occlude, --guard or --card"
        )
    trust(config.policy, config.trust)
    folder = checkpoint.find_policy(config.policy) if config.card else None
    if folder is not None:
        for name in (checkpoint.EVALUATION, checkpoint.DEVELOPMENT):
            checkpoint.shipped_evaluation(folder, name)  # Now: afterwards it is too late to fix.
            written_to(folder / name, "--card")
        written_to(folder / checkpoint.CARD, "--card")
    try:
        evaluation = evaluate(
            with_guard(with_wire(config.policy, config.wire), config.guard),
            config.subsets or None,
            episodes=config.episodes,
            seed=config.seed,
            workers=config.workers,
            occlusions=parse_occlusions(config.occlude),
            progress=True,
        )
    except Unfinished as stopped:
        raise Unfinished(str(stopped), stopped.result.to_json()) from stopped
    result = evaluation.to_json()
    if folder is not None:
        with saving(result, f"--card: {folder}"):
            write_measured(folder, result)
    return result


def write_measured(folder: Path, new: EvaluationFile) -> None:
    """Writes evaluation.json and card.md. Where that file has reporting seeds, read ones or not,
    others go to development.json; where it has other seeds, it moves there when reporting seeds
    come, unless there is such a file already."""
    file = checkpoint.EVALUATION
    known = checkpoint.shipped_evaluation(folder)
    before = seeds_of(known) if known else ""
    now = seeds_of(new)
    if known and now == REPORTING and before != REPORTING:
        if before == DEVELOPMENT or not (folder / checkpoint.DEVELOPMENT).exists():
            write_json(folder / checkpoint.DEVELOPMENT, known)
        else:
            say(f"{folder}: rates on {before} seeds give way; development.json stays as it is")
        known = None
    if before in (REPORTING, READ) and now not in (REPORTING, before):
        file = checkpoint.DEVELOPMENT
        known = checkpoint.shipped_evaluation(folder, file)
    if known and known["digest"] == new["digest"] and known["seed"] != new["seed"]:
        say(
            f"{folder / file}: its {len(known['episodes'])} episodes from seed {known['seed']} on "
            f"give way to {len(new['episodes'])} from {new['seed']} on"
        )
    write_json(folder / file, joined(known, new))
    seeds = {episode["seed"] for episode in new["episodes"]}
    note_reading(folder, new["policy"], new["task"], new["digest"], seeds)
    write_card(folder)


def joined(known: EvaluationFile | None, new: EvaluationFile) -> EvaluationFile:
    """``new`` and those subsets of ``known`` that it did not measure again, if both are of the same
    weights, definition and first seed; a card can so be filled in several goes."""
    same = ("digest", "definition", "seed")
    if known is None or any(known[key] != new[key] for key in same):
        return new
    before = {name: row for name, row in known["subsets"].items() if name not in new["subsets"]}
    episodes = [e for e in known["episodes"] if e["subset"] in before]
    return {
        **new,
        "subsets": {**before, **new["subsets"]},
        "episodes": [*episodes, *new["episodes"]],
    }


def success_table(result: EvaluationFile) -> str:
    """An evaluation as lines: subset, success with its interval, episodes."""
    lines = [f"{result['policy']} on {result['task']}: success {result['definition']}"]
    for name, row in result["subsets"].items():
        lines.append(
            f"  {name:24} {SuccessRate.read(row)}"
            f"   any step {row['success_any']:.2f}"
            + ("" if row["trained"] else "   not trained on this subset")
        )
    episodes = sum(row["n"] for row in result["subsets"].values())
    outside = sum(row["n"] * row.get("outside", 0.0) for row in result["subsets"].values())
    lines += filter(None, [clipped_words(outside / episodes), result.get("guard")])
    return "\n".join(lines)
