"""An actor as an ONNX graph, with or without its guard, and the guard alone.

The guard alone is what a robot asks between two decisions, while it carries out an action: is that
still safe, and what else to do? Both take and give a robot's units; `action`, in [-1, 1], is what
one tells the other.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.deployment.onnx_graph import EXTRA, Graph
from palpate.deployment.scaling import Scaling
from palpate.errors import extra_module
from palpate.networks import ActorPolicy, Guard, GuardedPolicy, count_of
from palpate.networks.actor import Perceptron
from palpate.runs.storage import write_bytes

_LARGEST = float(np.finfo(np.float32).max)
_NEAR = 1e-4  # risks as near to the threshold as that may fall on either side of it
_ROWS = 512  # compared
_WIDE = 3.0  # deviations, of half of them: features are about 1
_LOST = 8  # of them, in each of which a sensor has dropped out


def actor_model(policy: ActorPolicy, scaling: Scaling) -> Any:
    """The policy as an `onnx.ModelProto`: input `features`; outputs `command`, `action`.

    `features` (batch, features) and `command` (batch, *shape) are in the units of the scaling;
    `action` (batch, actions) is what the command is made of, in [-1, 1]. Where a number that is
    seen or given is not finite, the command is that of rest and the action zeros. A `GuardedPolicy`
    gives both after recovery, and `risk` (batch, 1), of what its actor proposed.

    Raises `PalpateError` without the extra `deploy`.
    """
    graph = Graph()
    seen = graph.add("Div", "features", graph.constant(scaling.scale))
    proposed = _action(graph, policy.actor.network, seen, count_of(policy.actions))
    outputs: dict[str, Any] = {}
    if isinstance(policy, GuardedPolicy):
        proposed = _overrule(graph, policy.guard, policy.threshold, seen, proposed)
        outputs["risk"] = [1]
    return _model(graph, scaling, seen, proposed, {}, outputs)


def guard_model(policy: GuardedPolicy, scaling: Scaling) -> Any:
    """Its guard alone: inputs `features`, `action`; outputs `command`, `action_out` and `risk`.

    `action` (batch, actions), in [-1, 1], is what is under way, and so is `action_out`, or the
    recovery's action where `risk` (batch, 1) is above the threshold; `command` is made of that. All
    else is as in `actor_model`, which also says what is raised.
    """
    graph = Graph()
    seen = graph.add("Div", "features", graph.constant(scaling.scale))
    executed = _overrule(graph, policy.guard, policy.threshold, seen, "action")
    inputs = {"action": [count_of(policy.actions)]}
    return _model(graph, scaling, seen, executed, inputs, {"risk": [1]})


def write_model(path: str | Path, model: Any) -> None:
    """Write what `actor_model` or `guard_model` gave; raises as `write_bytes`."""
    write_bytes(path, model.SerializeToString(deterministic=True))


def actor_difference(path: str | Path, policy: ActorPolicy, scaling: Scaling, seed: int) -> float:
    """The largest difference of a command between the file and the policy, as a share of its range.

    The file is that of `actor_model` or, of a guard, `guard_model`, run by ONNX Runtime, on random
    features of deviations 1 and 3 in some of which a sensor has dropped out. Where the risk is at
    the threshold rounding decides who acts: that is left out. Infinite where one is finite alone.

    Raises `PalpateError` without the extra `deploy`.
    """
    runtime = extra_module("onnxruntime", EXTRA)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    random = np.random.default_rng(seed)
    measured = random.normal(size=(_ROWS, len(scaling.scale))) * scaling.scale
    measured[_ROWS // 2 :] *= _WIDE
    measured[np.arange(_LOST), random.integers(len(scaling.scale), size=_LOST)] = np.nan
    inputs = {"features": measured.astype(np.float32)}
    seen = jnp.asarray(scaling.features(inputs["features"]))
    name, near = "action", np.zeros(_ROWS, bool)
    sound = np.all(np.isfinite(measured), axis=1, keepdims=True)
    if reflex := any(one.name == "action" for one in session.get_inputs()):
        name, size = "action_out", (_ROWS, len(scaling.low))
        inputs["action"] = random.uniform(-1, 1, size).astype(np.float32)
    if isinstance(policy, GuardedPolicy):
        proposed = jnp.asarray(inputs["action"]) if reflex else policy.propose(seen)
        near = np.abs(np.asarray(policy.risk(seen, proposed)) - policy.threshold) <= _NEAR
        ours = policy.guard.overrule(seen, proposed, policy.threshold)
    else:
        ours = policy.propose(seen)
    ours = np.where(sound, np.asarray(ours), 0.0)
    action, command = session.run([name, "command"], inputs)
    commanded = np.where(sound, scaling.command(ours), scaling.rest)
    span = np.where(scaling.high > scaling.low, scaling.high - scaling.low, np.abs(scaling.high))
    deviation = np.stack([action - ours, (command.reshape(_ROWS, -1) - commanded) / span])[:, ~near]
    return float(np.abs(np.where(np.isfinite(deviation), deviation, np.inf)).max())


def _model(
    graph: Graph,
    scaling: Scaling,
    seen: str,
    proposed: str,
    inputs: dict[str, Any],
    outputs: dict[str, Any],
) -> Any:
    """What is left to do: to stretch an action to a command, or to rest where all is not finite."""
    nothing, (middle, half) = graph.constant(0.0), scaling.stretch
    finite = _finite(graph, graph.add("Concat", seen, proposed, axis=1))
    name = "action_out" if inputs else "action"
    action = graph.add("Where", finite, proposed, nothing, output=name)
    away = graph.add("Add", graph.add("Mul", action, graph.constant(half)), graph.constant(middle))
    away = graph.add("Where", finite, away, nothing)
    parts, first = [], 0
    for channel in scaling.actions:
        part = graph.part(away, first, channel)
        if channel.limit is not None:
            part = graph.shortened(part, channel.limit)
        parts.append(graph.flat(part, channel.count))
        first += channel.count
    command = graph.add("Add", graph.add("Concat", *parts, axis=1), graph.constant(scaling.rest))
    shape = scaling.actions[0].shape if len(scaling.actions) == 1 else (first,)
    graph.add("Reshape", command, graph.constant([-1, *shape], np.int64), output="command")
    inputs = {"features": [len(scaling.scale)], **inputs}
    return graph.model(inputs, {"command": shape, name: [first], **outputs})


def _overrule(graph: Graph, guard: Guard, threshold: float, seen: str, action: str) -> str:
    """The action, or the recovery's where it is risky; the risk is the output `risk`."""
    part = seen
    if guard.seen is not None:
        part = graph.add("Gather", seen, graph.constant(guard.seen, np.int64), axis=1)
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


def _one(graph: Graph) -> str:
    return graph.constant(1.0)
