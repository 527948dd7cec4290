"""What a policy takes and gives, in words for whoever connects it to a robot.

A contract stands as JSON beside an exported policy: channels with order, units and limits,
normalisation, rate, how velocities were estimated in training, and what it was trained on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.networks import Channel, CommandPolicy, count_of
from palpate.perception.velocity import VelocityEstimator
from palpate.runs.storage import read_json, write_json

_FORMAT = "palpate.contract"
_VERSION = 2  # the first had one action, its limits beside it
_TRAINED = ("command", "seed", "training", "model", "machine", "wall_time_s")


def write_contract(
    path: str | Path, policy: CommandPolicy, manifest: Mapping[str, Any], file: str
) -> None:
    """Write the contract of the policy, whose manifest this is, exported as `file`."""
    action = {"shape": ["batch", *policy.action_shape], "dtype": "float32"}
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "file": file,
        "task": manifest.get("task"),
        "rate_hz": 1 / policy.period,
        "period_s": policy.period,
        "inputs": {
            "features": {
                "shape": ["batch", count_of(policy.observations)],
                "dtype": "float32",
                "order": _ordered(policy.observations),
                "normalisation": {
                    "done_by": "the policy: give features in their units",
                    "mean": policy.mean,
                    "scale": policy.scale,
                },
            },
            "carry": {
                **action,
                "about": "the command in force: zero at rest, then the last call's carry_out",
            },
        },
        "outputs": {
            "command": {
                **action,
                "order": _ordered(policy.actions),
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
        "trained": {name: manifest[name] for name in _TRAINED if name in manifest},
    }
    write_json(path, content)


def check_contract(path: str | Path) -> None:
    """Raise `PalpateError` unless the file is a contract, of whatever version."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise PalpateError(f"{path} is no contract: expected the JSON that `palpate export` wrote")


def _ordered(channels: Sequence[Channel]) -> list[dict[str, Any]]:
    """The channels as they lie one after the other: "first" is the first index of each."""
    rows, first = [], 0
    for channel in channels:
        rows.append({**dataclasses.asdict(channel), "first": first})
        first += channel.count
    return rows
