"""What a policy takes and gives, in words for whoever connects it to a robot.

A contract stands as JSON beside an exported policy: channels with order, units and limits,
normalisation, rate, how velocities were estimated in training, and what it was trained on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.deployment.deployment import Deployment
from palpate.deployment.tank import RobotFilter
from palpate.errors import PalpateError
from palpate.networks import (
    ActorPolicy,
    Channel,
    CommandPolicy,
    DeclaredController,
    GuardedPolicy,
    count_of,
)
from palpate.perception.velocity import VelocityEstimator
from palpate.runs.storage import read_json, write_json

_FORMAT = "palpate.contract"
_VERSION = 2  # the first had one action, its limits beside it
RISK = "of what was proposed: the discounted probability of a violation, in [0, 1]"
UNDER_WAY = "of the policy or, if it is later, this graph's last action_out"
FILTER = (
    "stands in the robot's program, before its drives: `palpate.safety.filters.filter_of(name, "
    "numbers)`, called in every control period with what is wanted then, and what passes is held"
)
LEVEL = "J: what is left in its tank, which `palpate serve` is sent as its last channel, `tank`"
_TRAINED = ("command", "seed", "training", "model", "machine", "wall_time_s")


def write_contract(path: str | Path, deployment: Deployment[CommandPolicy], file: str) -> None:
    """Write the contract of the deployment's policy, exported as `file`."""
    policy, manifest = deployment.policy, deployment.manifest
    action = {"shape": ["batch", *policy.action_shape], "dtype": "float32"}
    content = {
        **_head(policy, manifest, file),
        "inputs": {
            "features": _features(policy.observations, policy.mean, policy.scale),
            "carry": {
                **action,
                "about": "the command in force: zero at rest, then the last call's carry_out",
            },
        },
        "outputs": {
            "command": {
                **action,
                "order": _order(policy.actions),
                "limits": "of the Euclidean norm along a channel's last axis, in its unit; "
                "rate_limit of its change, per second",
                "about": "to be held for one period",
            },
            "carry_out": action,
        },
        "velocities": {
            "method": "sum of weight x position over the last frames, oldest first, one a period",
            "weights_per_s": VelocityEstimator(policy.period).weights,
        },
        **deployment.contract(),
        "trained": _training_of(manifest),
    }
    write_json(path, content | _filter_of(deployment.filter))


def write_actor_contract(
    path: str | Path,
    policy: ActorPolicy,
    deployment: Deployment,
    file: str,
    reflex: str | None = None,
) -> None:
    """Write the contract of the deployment's actor, exported as `file` and its `reflex`."""
    manifest, scaling, pace = deployment.manifest, deployment.scaling, deployment.pace
    risk = {"shape": ["batch", 1], "dtype": "float32", "about": RISK}
    action = {"shape": ["batch", len(scaling.rest)], "dtype": "float32", "limits": [-1, 1]}
    shape = scaling.actions[0].shape if len(scaling.actions) == 1 else (len(scaling.rest),)
    outputs: dict[str, Any] = {
        "command": {
            "shape": ["batch", *shape],
            "dtype": "float32",
            "order": _order(scaling.actions),
            "limits": "of the Euclidean distance from rest along a channel's last axis, in its "
            "unit; rate_limit of its change, per second",
            "low": scaling.low,
            "high": scaling.high,
            "rest": scaling.rest,
            "about": "to be held for one period: low + (high - low) (action + 1) / 2, shortened to "
            "the limits",
        },
        "action": {**action, "about": "what the command is made of"},
    }
    content = {
        **_head(policy, manifest, file),
        "inputs": {"features": _features(scaling.sensors, 0.0 * scaling.scale, scaling.scale)},
        "outputs": outputs,
        "fails_closed": "where any number of features is not finite, or one that the networks "
        "give, the command is that of rest and the action zeros",
        "trained": _training_of(manifest),
    }
    if isinstance(policy, GuardedPolicy):
        outputs["risk"] = risk
        content["guard"] = {
            "threshold": policy.threshold,
            "about": "where risk is above the threshold, action and command are the recovery's",
        }
    if reflex is not None and pace is not None:
        content["reflex"] = {
            "file": reflex,
            "rate_hz": 1 / pace.period,
            "period_s": pace.period,
            "pace": pace.count,
            "inputs": {"features": "as the policy's", "action": {**action, "about": UNDER_WAY}},
            "outputs": {
                "command": "as the policy's",
                "action_out": {**action, "about": "what is under way from now on"},
                "risk": risk,
            },
            "about": "to be asked every period_s with what the sensors show then. Where risk is "
            "above the threshold, command and action_out are the recovery's: a motion that begins "
            "now, holds until the next decision, and is itself replaced after no less than `pace` "
            "periods. Where features are not finite, rest until the next decision",
        }
    write_json(path, content | _filter_of(deployment.filter))


def _filter_of(robot_filter: RobotFilter | None) -> dict[str, Any]:
    """What a filter before the robot's drives adds to a contract."""
    if robot_filter is None:
        return {}
    about = {"about": FILTER}
    if robot_filter.tank is not None:
        about["level"] = LEVEL
    return {"filter": robot_filter.to_dict() | about}


def _head(policy: DeclaredController, manifest: Mapping[str, Any], file: str) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "file": file,
        "task": manifest.get("task"),
        "rate_hz": 1 / policy.period,
        "period_s": policy.period,
    }


def _features(channels: Sequence[Channel], mean: Any, scale: Any) -> dict[str, Any]:
    return {
        "shape": ["batch", count_of(channels)],
        "dtype": "float32",
        "order": _order(channels),
        "normalisation": {
            "done_by": "the policy: give features in their units",
            "mean": mean,
            "scale": scale,
        },
    }


def _training_of(manifest: Mapping[str, Any]) -> dict[str, Any]:
    return {name: manifest[name] for name in _TRAINED if name in manifest}


def check_contract(path: str | Path) -> None:
    """Raise `PalpateError` unless the file is a contract, of whatever version."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise PalpateError(f"{path} is no contract: expected the JSON that `palpate export` wrote")


def _order(channels: Sequence[Channel]) -> list[dict[str, Any]]:
    """The channels as they lie one after the other: "first" is the first index of each."""
    rows, first = [], 0
    for channel in channels:
        rows.append({**dataclasses.asdict(channel), "first": first})
        first += channel.count
    return rows
