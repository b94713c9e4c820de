"""policy.json of an audit's folder: the policy, and the seed or the recordings, it began with.

An audit goes on with the episodes of its folder, so it must go on with the same policy. Weights
have a digest. A policy without one is known by the name that its server says, and by its answer to
one fixed look: the first one of a selection seed. That answer counts only where the policy gives it
twice, because a policy may draw random numbers.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.measure.episodes import one_thread
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation
from madviz.observation.streams import StreamStack
from madviz.policies import checkpoint
from madviz.policies.guarded import unguarded
from madviz.policies.players import player_of
from madviz.policies.seeds import FIRST_SELECTION
from madviz.subsets import cameras_of, every_mask
from madviz.system.files import read_json, write_json
from madviz.types import Array, Policy
from madviz.wire.policy import ServedPolicy

FILE = "policy.json"
SAME = 1e-3
"""Answers that differ by less are the same: other hardware rounds in another way."""


class AuditedPolicy(TypedDict):
    """The whole file."""

    schema: int
    policy: str
    digest: str
    identity: dict[str, str]
    """The words of a server on what it serves; empty for others."""
    answer: list[float] | None
    """The action (A,) after a fixed look; None where the digest is enough, or answers differ."""
    seed: int
    """The first episode's."""
    recording: str
    """Name and digest of the recordings that it is asked about; '' in a simulator."""


def check_same_policy(out: Path, policy: Policy, seed: int, recording: str = "") -> None:
    """Writes policy.json into the folder ``out``, or compares. Raises UserError where the audit in
    ``out`` began with another policy, another seed or another ``recording``."""
    before = _begun(out)
    served = isinstance(policy, ServedPolicy)
    now: AuditedPolicy = {
        "schema": 1,
        "policy": policy.spec.name,
        "digest": policy.spec.digest,
        "identity": policy.identity if served else {},
        "answer": None,
        "seed": seed,
        "recording": recording,
    }
    _compare(out, "policy", before.get("policy"), now["policy"])
    _compare(out, "policy that says", before.get("identity"), now["identity"])
    _compare(out, "policy and wiring with the digest", before.get("digest"), now["digest"])
    _compare(out, "--seed", before.get("seed"), seed)
    _compare(out, "recordings", before.get("recording"), recording)
    has_digest = policy.has_digest if served else bool(policy.spec.digest)  # Of the weights.
    now["answer"] = None if has_digest else repeated_answer(policy)
    known = before.get("answer")
    if known is not None and now["answer"] is not None:
        if np.shape(known) != np.shape(now["answer"]) or not _agree(known, now["answer"]):
            _compare(out, "policy that answers a fixed look with", known, now["answer"])
    if not (out / FILE).exists():
        write_json(out / FILE, now)


def repeats_itself(reference: str, policy: Policy) -> bool:
    """True for a policy folder, and for a policy whose first two actions (A,) differ by less than
    ``SAME`` in a second episode of the same seed and looks. It is asked with all cameras, or with
    a subset that it supports."""
    if checkpoint.is_folder(unguarded(reference)):
        return True
    streams = policy.spec.streams
    masks = [mask for mask in every_mask(len(streams)) if policy.supports(mask)]
    if not masks:
        return True
    stack, state = _first_look(policy)
    answers = []
    for _ in range(2):
        with closing(player_of(policy, FIRST_SELECTION)) as player, one_thread():
            encoded = policy.encode(stack.views, state)
            answers.append([player.act(encoded, masks[0]) for _ in range(2)])  # (2, A)
    return _agree(*map(np.stack, answers))


def repeated_answer(policy: Policy) -> list[float] | None:
    """The action (A,) after a fixed look with all cameras; None where a second one differs, or the
    policy cannot act on all cameras."""
    spec = policy.spec
    mask = np.ones(len(spec.streams), bool)  # (V,)
    if not policy.supports(mask):
        return None
    stack, state = _first_look(policy)
    answers = []
    for _ in range(2):
        if isinstance(policy, ServedPolicy):
            policy.close()  # Each ask is the first one of a connection.
        with one_thread():
            encoded = policy.encode(stack.views, state)
            answers.append(policy.read(encoded, mask[None]).action[0])  # (A,)
    first, second = answers
    return [round(float(x), 6) for x in first] if _agree(first, second) else None


def _first_look(policy: Policy) -> tuple[StreamStack, Array]:
    """The pictures and the state (S,) that a policy gets at the first step of a selection seed."""
    spec = policy.spec
    with closing(make_env(spec.task, spec.render_profile, spec.cameras)) as env:
        now = env.reset(FIRST_SELECTION)
        stack = stack_of(spec, env.spec)
        views = {camera: env.view(camera) for camera in cameras_of(spec.streams)}
        stack.push(views, Ablation({}), FIRST_SELECTION, 0)
    return stack, now.state


def _begun(out: Path) -> dict[str, Any]:
    """The policy with which the audit in ``out`` began; empty for a new folder. Older versions
    wrote it into audit.json only."""
    for name in (FILE, "audit.json"):
        if (out / name).is_file():
            document = read_json(out / name)
            return document if isinstance(document, dict) else {}
    return {}


def _compare(out: Path, what: str, before: object, now: object) -> None:
    """Raises UserError for values that differ; a value that was not stored differs from none."""
    if before is not None and before != now:
        raise UserError(
            f"--out {out}: expected the {what} {before!s:.150} with which the audit in this folder "
            f"began, found {now!s:.150}; choose another folder, or remove this one"
        )


def _agree(first: Array | list[float], second: Array | list[float]) -> bool:
    return bool(np.allclose(first, second, rtol=0, atol=SAME))
