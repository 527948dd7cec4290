"""A command policy as an ONNX graph."""

from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from palpate.deployment.onnx_graph import EXTRA, Graph
from palpate.errors import PalpateError, extra_module
from palpate.networks import Channel, CommandPolicy
from palpate.runs.storage import write_bytes


def onnx_model(policy: CommandPolicy) -> Any:
    """The policy as an `onnx.ModelProto`: inputs `features`, `carry`; outputs `command`,
    `carry_out`.

    `features` are (batch, features) in the task's units; the others (batch, *action_shape) in the
    action's. All are float32. The formula is that of `palpate.networks.CommandPolicy`.

    Raises `PalpateError` without the extra `deploy`.
    """
    graph = Graph()
    centred = graph.add("Sub", "features", graph.constant(policy.mean))
    seen = graph.add("Div", centred, graph.constant(policy.scale))
    shape = list(policy.action_shape)
    flat = graph.add("Flatten", "carry", axis=1)
    previous = graph.add("Div", flat, graph.constant(_limits(policy)))
    output = graph.add("Concat", seen, previous, axis=1)
    for number, layer in enumerate(policy.network.layers):
        if number:
            output = graph.add("Tanh", output)
        weight, bias = graph.constant(layer.weight), graph.constant(layer.bias)
        output = graph.add("Gemm", output, weight, bias, transB=1)
    moved, first = [], 0
    for channel in policy.actions:
        own = [graph.part(whole, first, channel) for whole in (output, flat)]
        moved.append(graph.flat(_move(graph, channel, policy.period, *own), channel.count))
        first += channel.count
    command = graph.add("Concat", *moved, axis=1)
    command = graph.add("Reshape", command, graph.constant([-1, *shape], np.int64))
    graph.add("Identity", command, output="command")
    graph.add("Identity", command, output="carry_out")
    inputs = {"features": policy.mean.shape, "carry": shape}
    return graph.model(inputs, {"command": shape, "carry_out": shape})


def _move(graph: Graph, channel: Channel, period: float, output: str, before: str) -> str:
    """The next command of one channel, from the network's output and the command before."""
    limit, one = graph.constant(channel.bound), graph.constant(1.0)
    length = graph.add("Sqrt", graph.add("Add", graph.square(output), one))
    direction = graph.add("Div", output, length)
    if channel.rate_limit is None:
        return graph.add("Mul", direction, limit)
    change = graph.add("Mul", direction, graph.constant(period * channel.rate_limit))
    return graph.shortened(graph.add("Add", before, change), channel.bound)


def write_onnx(path: str | Path, policy: CommandPolicy) -> None:
    """Write `onnx_model(policy)` to a file.

    Raises `PalpateError` without the extra `deploy`, and as `write_bytes`.
    """
    write_bytes(path, onnx_model(policy).SerializeToString(deterministic=True))


class OnnxNetwork:
    """An exported file that decides as the policy does it was made of.

    Raises `PalpateError` for a file that is none of such a policy, and without the extra `deploy`.
    """

    def __init__(self, path: str | Path, policy: CommandPolicy):
        runtime = extra_module("onnxruntime", EXTRA)
        self._shape = (1, *policy.action_shape)
        try:
            self._session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
            self(np.zeros(policy.mean.shape, np.float32), np.zeros(self._shape, np.float32))
        except Exception as error:  # ONNX Runtime has a class for each kind of failure
            raise PalpateError(
                f"{path} cannot decide for this policy: expected what `palpate export` makes of it "
                f"({' '.join(str(error).split())})"
            ) from error

    def run(self, features: np.ndarray, carry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Commands and the next carry, (batch, *action_shape), of features (batch, features)."""
        given = {"features": features, "carry": carry}
        command, carry = self._session.run(["command", "carry_out"], given)
        return command, carry

    def __call__(self, features: np.ndarray, command: np.ndarray) -> np.ndarray:
        """As `palpate.deployment.decision.NetworkDecision`."""
        return self.run(features[None], command.reshape(self._shape))[0].reshape(-1)


def difference(path: str | Path, policy: CommandPolicy, steps: int, seed: int) -> float:
    """The largest difference of any command between the file, run by ONNX Runtime, and the policy.

    Over random features (mean and spread of what it was trained to see, and ten times that), each
    fed with its own carry for `steps` calls. As a share of the limit of its channel.

    Raises `PalpateError` without the extra `deploy`.
    """
    network = OnnxNetwork(path, policy)
    random, batch = np.random.default_rng(seed), 64
    mean, scale = np.asarray(policy.mean), np.asarray(policy.scale)
    spread = scale * np.where(np.arange(batch) < batch // 2, 1.0, 10.0)[:, None]
    ours = theirs = np.zeros((batch, *policy.action_shape), np.float32)
    limits = _limits(policy)
    worst, decide = 0.0, eqx.filter_jit(lambda policy, carry, seen: policy(carry, seen)[0])
    for _ in range(steps):
        features = (mean + spread * random.normal(size=spread.shape)).astype(np.float32)
        ours = np.asarray(decide(policy, ours, features))
        command, theirs = network.run(features, theirs)
        worst = max(worst, float((np.abs(command - ours).reshape(batch, -1) / limits).max()))
    return worst


def _limits(policy: CommandPolicy) -> np.ndarray:
    """Of every number of a command that of its channel, (commands,)."""
    limits = [channel.bound for channel in policy.actions]
    return np.repeat(limits, [channel.count for channel in policy.actions])
