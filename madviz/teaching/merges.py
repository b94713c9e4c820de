"""For lesson 7: which camera a merge with attention listens to."""

from __future__ import annotations

import numpy as np
import torch

from madviz.agent.agent import TorchPolicy
from madviz.agent.merges.attention import HEADS, CrossAttention, attend, split_heads
from madviz.agent.merges.vit import ViewTransformer
from madviz.errors import UserError
from madviz.subsets import mask_of
from madviz.teaching import Moment
from madviz.teaching.names import named
from madviz.teaching.show import TextTable, table
from madviz.types import Array


def attention_shares(policy: TorchPolicy, moment: Moment, subset: str) -> TextTable:
    """Which share of its attention each present view gives to each view under ``subset``, a mean
    over heads and places; from the network's own queries and keys.

    Raises UserError for a policy without attention.
    """
    net = policy.agent.encoder
    if not isinstance(net, CrossAttention | ViewTransformer):
        raise UserError(f"expected a policy that attends, found {policy.spec.name}")
    outputs: dict[str, torch.Tensor] = {}

    def store(name: str):
        return lambda module, inputs, output: outputs.__setitem__(name, output)

    hooks = [getattr(net, n).register_forward_hook(store(n)) for n in ("query", "key")]
    streams = policy.spec.streams
    mask = mask_of(subset, streams)
    policy.read(policy.encode(moment.stack, moment.state), mask[None])
    for hook in hooks:
        hook.remove()
    shares = _shares(outputs["query"], outputs["key"], mask, isinstance(net, ViewTransformer))
    rows = [[named(name), *shares[i]] for i, name in enumerate(streams) if mask[i]]
    return table(["attends to", *map(named, streams)], rows)


def _shares(query: torch.Tensor, key: torch.Tensor, mask: Array, itself: bool) -> Array:
    """(1, T, D) twice, (V,) -> (V, V) shares, zeros where no view may be attended to. The values
    are replaced by the one-hot index of their view, so that the outputs are the shares."""
    views = len(mask)
    tokens = query.shape[1]
    places = tokens // views
    who = np.tile(mask, (views, 1)) & (itself | ~np.eye(views, dtype=bool))
    allowed = torch.from_numpy(who.repeat(places, 0).repeat(places, 1))
    query, key = map(split_heads, (query, key))
    one_hot = torch.eye(views).repeat_interleave(places, 0).expand(1, HEADS, -1, -1)
    shares = attend(query, key, one_hot, allowed)[0].unflatten(-1, (HEADS, views)).mean(1)
    return shares.unflatten(0, (views, places)).mean(1).numpy() * who.any(1, keepdims=True)
