"""Recordings of MuJoCo ropes, and the rope model that an identification starts from."""

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np

from palpate.errors import PalpateError
from palpate.models.rope import Rope
from palpate.models.rope.stability import LIMIT
from palpate.parameters import declare
from palpate.perception.rope.nodes import at_nodes
from palpate.recordings import Aligned, Channel, Driven, Recording, Role, Trial
from palpate.worlds.excitation import excitation, record
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld

MARKERS, GRIPPER, COMMAND, FORCE = "markers", "gripper", "command", "force"
NODE_MASS = 4e-3  # kg, where nothing was weighed: the motion tells stiffness per mass and no more
TIME_STEP = 1e-3  # s, about, of the model's integration
BEND_DAMPING = 6e-4  # m^4/s, over the rope's density, that a model should be able to integrate
FEWEST_NODES = 4
STRETCHED, UNEVEN = 0.15, 0.03  # of a length: by which equal segments differ along a line, off it


def record_rope(
    configuration: RopeConfiguration, seeds: Iterable[int], duration: float
) -> Recording:
    """Shake a MuJoCo rope from hanging, one trial of `duration` seconds for each seed.

    Channels: `markers` (frames, markers, 3) as seen, `gripper` (frames, 1, 3) where the driven end
    was, `command` (steps, 1, 3) the velocity that was ordered, and `force` (frames, 1, 3) what the
    rope pulled the gripper with. Raises `PalpateError` when the simulation diverges.
    """
    world = RopeWorld(configuration)
    trials = []
    for seed in seeds:
        motion = excitation(
            seed, duration, world.control_period, world.speed_limit, world.acceleration_limit
        )
        data = record(world, motion, seed)
        channels = (
            Channel(MARKERS, Role.OBSERVATION, data["time"], data["markers"], "m"),
            Channel(GRIPPER, Role.DRIVEN, data["time"], data["gripper_position"][:, None], "m"),
            Channel(FORCE, Role.OBSERVATION, data["time"], data["grip_force"][:, None], "N"),
            Channel(COMMAND, Role.COMMAND, data["command_time"], data["command"][:, None], "m/s"),
        )
        by_name = {channel.name: channel for channel in channels}
        trials.append(Trial(f"seed {seed}", by_name, facts={GRIPPER: Driven(MARKERS, (0,))}))
    return Recording(tuple(trials), {"source": "MuJoCo rope"} | constants(configuration))


def constants(configuration: RopeConfiguration) -> dict[str, str | float | int]:
    """The plain constants of a world, for provenance and results."""
    return {
        f"world.{name}": value
        for name, value in dataclasses.asdict(configuration).items()
        if isinstance(value, str | int | float)
    }


def choose_node_count(aligned: Aligned, substeps: int | None = None) -> int:
    """How many nodes a model of this rope should have: as many as markers, or fewer.

    With `substeps` in a period, or the usual number. The most bend damping c (N m^2 s) that steps
    of h s can integrate on segments of l m is, for a rope of r kg/m without anything else, given by
    32 h c / (r l^4) = `LIMIT`: see `palpate.models.rope.stability`. Nodes are no closer than where
    c / r is `BEND_DAMPING`. A fit of closer ones makes up for damping that they cannot have by too
    much stiffness, and one of nodes far apart for their coarse chain.
    """
    nodes = markers = aligned.observation.shape[2]
    time_step = aligned.period / (substeps or usual_substeps(aligned))
    closest = (32 * time_step * BEND_DAMPING / LIMIT) ** 0.25
    for _ in range(2):  # once more, as noise lengthens a rope of close markers
        distance = np.linalg.norm(np.diff(at_nodes(aligned.observation, nodes), axis=2), axis=-1)
        seen = np.isfinite(distance)
        mean = np.sum(distance, (0, 1), where=seen) / np.maximum(seen.sum((0, 1)), 1)
        nodes = min(markers, max(FEWEST_NODES, 1 + math.floor(mean.sum() / closest)))
    return nodes


def usual_substeps(aligned: Aligned) -> int:
    """Of a period, so that a time step lasts about `TIME_STEP`."""
    return max(1, round(aligned.period / TIME_STEP))


def starting_rope(
    aligned: Aligned,
    driven: Sequence[int] = (0,),
    mass: float | None = None,
    *,
    one_length: bool = False,
) -> Rope:
    """The rope an identification starts from: as many nodes as markers, segments as long as seen.

    `mass` (kg) is the whole rope's. With `one_length` its segments are equal at rest where their
    seen lengths follow a straight line, as those of a rope stretched by its own weight do: what
    stretch there is would else stay in the pattern that one shared rest length scales. Raises
    `PalpateError` for too few markers, or neighbouring ones that coincide.
    """
    nodes = aligned.observation.shape[2]
    if nodes < FEWEST_NODES:
        raise PalpateError(
            f"a rope needs at least {FEWEST_NODES} markers and nodes, and here are {nodes}"
        )
    distance = np.linalg.norm(np.diff(aligned.observation, axis=2), axis=-1)
    rest_length = np.nanmean(distance, axis=(0, 1))
    if not np.all(rest_length > 0):
        first = int(np.argmin(rest_length > 0))
        raise PalpateError(
            f"markers {first} and {first + 1} are never seen apart: give the markers in order "
            "along the rope"
        )
    if one_length:
        index, mean = np.arange(nodes - 1), np.mean(rest_length)
        line = np.polynomial.Polynomial.fit(index, rest_length, 1)(index)
        if np.ptp(line) < STRETCHED * mean and np.ptp(rest_length - line) < UNEVEN * mean:
            rest_length = np.full_like(rest_length, mean)
    rope = Rope.from_rest_lengths(
        rest_length,
        NODE_MASS * nodes if mass is None else mass,
        driven=tuple(driven),
        drive="position",
        control_period=aligned.period,
        substeps=usual_substeps(aligned),
    )
    if rope.held_at_both_ends:
        # Two grips show how a rope is bent at rest and how its mass is spread.
        rope = declare(rope, rest_bend={"fixed": False}, node_mass={"fixed": False})
    if 0 not in rope.driven or 1 in rope.driven:  # no grip, or it turns the first segment itself
        rope = declare(rope, grip_stiffness={"fixed": True}, grip_damping={"fixed": True})
    return rope
