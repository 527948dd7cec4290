"""What a policy takes and gives, in words for whoever connects it to a robot.

A contract stands as JSON beside an exported policy: inputs with order and units, normalisation,
outputs, rate, limits, how velocities were estimated in training, and what it was trained on. The
real-time loop of palpate goes by the same contract.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.networks import CommandPolicy
from palpate.perception.velocity import VelocityEstimator
from palpate.runs.storage import plain, read_json, write_json

_FORMAT = "palpate.contract"
_VERSION = 1
_TRAINED = ("command", "seed", "training", "model", "machine", "wall_time_s")


@dataclass(frozen=True)
class Block:
    """Consecutive features of one kind: `shape` in C order from index `first` on, in `unit`."""

    name: str
    shape: tuple[int, ...]
    unit: str
    first: int

    @property
    def count(self) -> int:
        """How many features it is."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class Contract:
    """See the module. `features` are given as they are: the policy normalises them itself, by
    (features - mean) / scale.

    `speed_limit` bounds the Euclidean norm of a command along its last axis, in `unit`;
    `acceleration_limit` that of its change per second (None: no limit). The carry is the command in
    force: zero for a robot at rest, then what the policy gave last. `velocity_weights` (1/s)
    multiply the last positions, one every period, oldest first; their sum of products is the
    velocity that the policy was trained to see. `trained`: command, seed, settings and model.
    """

    task: str
    features: tuple[Block, ...]
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    command: str
    unit: str
    command_shape: tuple[int, ...]
    period: float
    speed_limit: float
    acceleration_limit: float | None
    velocity_weights: tuple[float, ...]
    trained: Mapping[str, Any]

    @property
    def rate(self) -> float:
        """Decisions per second, Hz."""
        return 1 / self.period


def contract_of(policy: CommandPolicy, manifest: Mapping[str, Any]) -> Contract:
    """The contract of a policy and the manifest that `load_policy` gave with it.

    Raises `PalpateError` where the manifest does not say what the features or the action are.
    """
    (action,) = policy.actions
    blocks, first = [], 0
    for channel in policy.observations:
        blocks.append(Block(channel.name, channel.shape, channel.unit, first))
        first += channel.count
    return Contract(
        task=str(manifest.get("task")),
        features=tuple(blocks),
        mean=tuple(policy.mean.tolist()),
        scale=tuple(policy.scale.tolist()),
        command=action.name,
        unit=action.unit,
        command_shape=policy.action_shape,
        period=policy.period,
        speed_limit=action.bound,
        acceleration_limit=action.rate_limit,
        velocity_weights=tuple(VelocityEstimator(policy.period).weights.tolist()),
        trained={name: manifest[name] for name in _TRAINED if name in manifest},
    )


def write_contract(path: str | Path, contract: Contract, file: str) -> None:
    """Write the contract of the exported policy `file` as JSON."""
    features = sum(block.count for block in contract.features)
    told = {
        "format": _FORMAT,
        "version": _VERSION,
        "file": file,
        "task": contract.task,
        "rate_hz": contract.rate,
        "period_s": contract.period,
        "inputs": {
            "features": {
                "shape": ["batch", features],
                "dtype": "float32",
                "order": [dataclasses.asdict(block) for block in contract.features],
                "normalisation": {
                    "done_by": "the policy: give features in their units",
                    "mean": contract.mean,
                    "scale": contract.scale,
                },
            },
            "carry": {
                "shape": ["batch", *contract.command_shape],
                "dtype": "float32",
                "unit": contract.unit,
                "about": "the command in force: zero at rest, then the last call's carry_out",
            },
        },
        "outputs": {
            "command": {
                "name": contract.command,
                "shape": ["batch", *contract.command_shape],
                "dtype": "float32",
                "unit": contract.unit,
                "about": "to be held for one period",
            },
            "carry_out": {"shape": ["batch", *contract.command_shape], "dtype": "float32"},
        },
        "limits": {
            "norm": "Euclidean, along the last axis",
            "command": contract.speed_limit,
            "command_per_s": contract.acceleration_limit,
        },
        "velocities": {
            "method": "sum of weight x position over the last frames, oldest first, one a period",
            "weights_per_s": contract.velocity_weights,
        },
        "trained": contract.trained,
    }
    write_json(path, told)


def read_contract(path: str | Path) -> Contract:
    """The contract that `write_contract` wrote.

    Raises `PalpateError` for another file, another version, or one where something is missing.
    """
    told = read_json(path)
    if not isinstance(told, dict) or told.get("format") != _FORMAT:
        raise PalpateError(f"{path} is no contract: expected the JSON that `palpate export` wrote")
    if told.get("version") != _VERSION:
        raise PalpateError(
            f"{path} has version {told.get('version')}; this palpate reads version {_VERSION}"
        )
    try:
        seen, given = told["inputs"]["features"], told["outputs"]["command"]
        return Contract(
            task=told["task"],
            features=tuple(
                Block(block["name"], tuple(block["shape"]), block["unit"], block["first"])
                for block in seen["order"]
            ),
            mean=tuple(seen["normalisation"]["mean"]),
            scale=tuple(seen["normalisation"]["scale"]),
            command=given["name"],
            unit=given["unit"],
            command_shape=tuple(given["shape"][1:]),
            period=told["period_s"],
            speed_limit=told["limits"]["command"],
            acceleration_limit=told["limits"]["command_per_s"],
            velocity_weights=tuple(told["velocities"]["weights_per_s"]),
            trained=plain(told["trained"]),
        )
    except (KeyError, TypeError, IndexError) as error:
        raise PalpateError(f"{path} is damaged: {error!r} where the contract should be") from error
