"""A policy as one ONNX graph, which a browser runs in WebAssembly.

    views (V, 9, 84, 84) uint8, state (1, S), masks (N, V) of 0 and 1
        -> features (V, Z), merged (N, Z), action (N, A), q (N)

The same graph reads one subset or all of them; dropping a camera is a row of ``masks``, as on the
server. Weights are stored in 16 bits, which loses nothing, since policy folders hold 16 bits too,
and are widened when the graph is loaded: 2.7 MB instead of 5.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from madviz.agent.agent import TorchPolicy
from madviz.agent.networks import Encoder
from madviz.errors import UserError
from madviz.observation.streams import IMAGE_SIZE

_OPSET = 18
_SMALL = 64
"""Numbers in a weight up to which it stays in 32 bits."""


class _Graph(nn.Module):
    def __init__(self, policy: TorchPolicy) -> None:
        super().__init__()
        self.agent = policy.agent
        self.scale = policy._reward_scale

    def forward(self, views: Tensor, state: Tensor, masks: Tensor) -> tuple[Tensor, ...]:
        encoder: Any = self.agent.encoder
        features = _features(encoder, views)
        rows = masks @ features
        states = state.expand(masks.shape[0], -1)
        action = torch.tanh(self.agent.actor(rows, states)[0])
        q = torch.minimum(*self.agent.critic(rows, states, action)) / self.scale
        return features, rows, action, q


def _features(encoder: Encoder, views: Tensor) -> Tensor:
    """``Encoder.forward`` with plain subtraction: its byte trick has no counterpart in ONNX."""
    weight = encoder.conv1.weight / 255
    assert encoder.conv1.bias is not None
    bias = encoder.conv1.bias + 0.5 * weight.sum((1, 2, 3))
    x = F.relu(F.conv2d(views.float() - 128, weight, bias, stride=4))
    return F.relu(encoder.conv3(F.relu(encoder.conv2(x)))).flatten(1)


def policy_graph(policy: Any) -> bytes:
    """The policy as an ONNX file. Raises UserError for one that does not sum the features of one
    encoder, and where the packages that write ONNX are missing."""
    if not isinstance(policy, TorchPolicy) or policy.agent.merge_name != "sum":
        raise UserError(
            f"expected a policy that sums features, found {policy.spec.name}; "
            "choose one whose merge is sum"
        )
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401  (torch's exporter asks for it.)
    except ImportError as error:
        raise UserError(
            f"expected the packages that write ONNX, found no {error.name}; "
            "install them with: pip install 'madviz[site]'"
        ) from error
    spec = policy.spec
    agent = policy.agent
    channels = 3 * spec.frame_stack
    streams = len(spec.streams)
    views = torch.zeros(streams, channels, IMAGE_SIZE, IMAGE_SIZE, dtype=torch.uint8)
    state = torch.zeros(1, agent.config.state_dim)
    # More than one row, or the exporter takes their number for a constant.
    masks = torch.eye(streams + 1, streams)
    program = torch.onnx.export(
        _Graph(policy).eval(),
        (views, state, masks),
        input_names=["views", "state", "masks"],
        output_names=["features", "merged", "action", "q"],
        dynamic_shapes=({}, {}, {0: torch.export.Dim("subsets", min=1, max=4096)}),
        opset_version=_OPSET,
        dynamo=True,
        optimize=True,
        verbose=False,
    )
    assert program is not None
    return _halved(program.model_proto).SerializeToString()


def _halved(model: Any) -> Any:
    """Weights in 16 bits, each followed by a cast, which the runtime works out when it loads."""
    from onnx import TensorProto, helper, numpy_helper

    graph = model.graph
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size <= _SMALL:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(
            helper.make_node("Cast", [f"{name}.half"], [name], f"{name}.cast", to=TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    del graph.value_info[:]
    return model
