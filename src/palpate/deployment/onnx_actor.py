"""An actor as an ONNX graph, with or without its guard, and the guard alone.

The guard alone is what a robot asks between two decisions, while it carries out an action: is that
still safe, and what else to do?
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.deployment.onnx_graph import EXTRA, Graph
from palpate.errors import extra_module
from palpate.networks import ActorPolicy, Guard, GuardedPolicy, count_of
from palpate.networks.actor import Perceptron
from palpate.runs.storage import write_bytes

_LARGEST = float(np.finfo(np.float32).max)
_NEAR = 1e-4  # risks as near to the threshold as that may fall on either side of it


def actor_model(policy: ActorPolicy) -> Any:
    """The policy as an `onnx.ModelProto`: input `features` (batch, features), output `command`.

    The command, (batch, *shape), is in [-1, 1], and zero where it is not finite. A `GuardedPolicy`
    gives that after recovery, and `risk` (batch, 1), of what its actor proposed.

    Raises `PalpateError` without the extra `deploy`.
    """
    graph = Graph()
    features, actions = count_of(policy.observations), count_of(policy.actions)
    proposed = _action(graph, policy.actor.network, "features", actions)
    outputs: dict[str, Any] = {}
    if isinstance(policy, GuardedPolicy):
        proposed = _overruled(graph, policy.guard, policy.threshold, proposed)
        outputs["risk"] = [1]
    shape = policy.actions[0].shape if len(policy.actions) == 1 else (actions,)
    command = _still(graph, proposed)
    graph.add("Reshape", command, graph.constant([-1, *shape], np.int64), output="command")
    return graph.model({"features": [features]}, {"command": shape, **outputs})


def guard_model(policy: GuardedPolicy) -> Any:
    """Its guard alone: inputs `features`, `action` (batch, actions); outputs `command`, `risk`.

    `command` (batch, actions) is the action, or the recovery's where `risk` (batch, 1) is above
    the threshold, and zero where it is not finite. Raises as `actor_model`.
    """
    graph = Graph()
    features, actions = count_of(policy.observations), count_of(policy.actions)
    executed = _overruled(graph, policy.guard, policy.threshold, "action")
    graph.add("Identity", _still(graph, executed), output="command")
    inputs = {"features": [features], "action": [actions]}
    return graph.model(inputs, {"command": [actions], "risk": [1]})


def write_model(path: str | Path, model: Any) -> None:
    """Write what `actor_model` or `guard_model` gave; raises as `write_bytes`."""
    write_bytes(path, model.SerializeToString(deterministic=True))


def actor_difference(path: str | Path, policy: ActorPolicy, seed: int) -> float:
    """The largest difference of any number of a command between the file and the policy.

    The file is that of `actor_model`, run by ONNX Runtime, on random features of deviations 1 and
    10. Commands whose risk is at the threshold are left out: rounding decides there who acts.

    Raises `PalpateError` without the extra `deploy`.
    """
    runtime = extra_module("onnxruntime", EXTRA)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    size = (512, count_of(policy.observations))
    features = np.random.default_rng(seed).normal(size=size).astype(np.float32)
    features[256:] *= 10.0
    theirs = session.run(["command"], {"features": features})[0]
    ours = policy(None, jnp.asarray(features))[1]
    off = np.abs(np.asarray(ours) - theirs).reshape(len(features), -1).max(axis=1)
    if isinstance(policy, GuardedPolicy):
        risk = policy.risk(jnp.asarray(features), policy.propose(jnp.asarray(features)))
        off = off[np.abs(np.asarray(risk) - policy.threshold) > _NEAR]
    return float(off.max())


def _overruled(graph: Graph, guard: Guard, threshold: float, action: str) -> str:
    """The action, or the recovery's where it is risky; the risk is the output `risk`."""
    part = "features"
    if guard.seen is not None:
        part = graph.add("Gather", part, graph.constant(guard.seen, np.int64), axis=1)
    inputs, critic = graph.add("Concat", part, action, axis=1), guard.critic.network
    members = [
        graph.add("Sigmoid", _layers(graph, critic, inputs, member))
        for member in range(critic.weights[0].shape[0])
    ]
    risk = graph.add("Where", _finite(graph, inputs), graph.add("Max", *members), _one(graph))
    risk = graph.add("Where", _finite(graph, risk), risk, _one(graph), output="risk")
    risky = graph.add("Greater", risk, graph.constant(threshold))
    return graph.add("Where", risky, _action(graph, guard.recovery.network, part), action)


def _action(graph: Graph, network: Perceptron, inputs: str, count: int | None = None) -> str:
    """The squashed mean: the first outputs, before a Gaussian's deviations."""
    output = _layers(graph, network, inputs)
    if count not in (None, network.sizes[-1]):
        bounds = (graph.constant([place], np.int64) for place in (0, count, 1))
        output = graph.add("Slice", output, *bounds)
    # Some runtimes make 0 of NaN where a layer cuts at 0: what went in has to be looked at.
    nothing = graph.constant(np.nan)
    return graph.add("Where", _finite(graph, inputs), graph.add("Tanh", output), nothing)


def _layers(graph: Graph, network: Perceptron, inputs: str, member: int | None = None) -> str:
    values = inputs
    for number, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        own = (weight, bias) if member is None else (weight[member], bias[member])
        values = graph.add("Relu", values) if number else values
        values = graph.add("Gemm", values, *(graph.constant(one) for one in own))
    return values


def _finite(graph: Graph, values: str) -> str:
    """Whether all numbers of a row are finite, (batch, 1)."""
    each = graph.add("LessOrEqual", graph.add("Abs", values), graph.constant(_LARGEST))
    counted = graph.add("Cast", each, to=1)  # to float: there is no minimum of truth values
    least = graph.add("ReduceMin", counted, axes=[1], keepdims=1)
    return graph.add("Greater", least, graph.constant(0.5))


def _still(graph: Graph, action: str) -> str:
    """The action, or zeros where any of its numbers is not finite."""
    return graph.add("Where", _finite(graph, action), action, graph.constant(0.0))


def _one(graph: Graph) -> str:
    return graph.constant(1.0)
