"""What a recording of touches says of itself, and the model that is fitted to it."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.models.contact import Tip, tip_with_walls
from palpate.recordings import Aligned, Channel, Quantity, Recording, Role, Trial
from palpate.worlds.contact.touching import NORMALS

UNITS = {"position": "m", "force": "N", "setpoint": "m", "stiffness": "N/m"}
COMMANDS = "setpoint", "stiffness"
MOVES = "setpoint velocity"  # m/s, of set-points that are ordered more often than a frame is seen
FEELS = 6.0  # deviations of the force's noise from which on a wall is felt
PRESSES = 0.25  # of the great forces, from which on it is a wall and no tool that is accelerated
PLACES = 200  # tried for a wall, from the deepest frame to the farthest
FEWEST = 20  # frames of contact by which a wall can be placed
WIDE = math.radians(50.0)  # from a wall's direction, within which a force is that wall's
LARGEST = 5.0  # m: a tip that is farther from where it was is in another unit


def with_channels(recording: Recording, names: Mapping[str, Sequence[str]]) -> Recording:
    """The recording with channels of two numbers called as `UNITS`, of those that are named.

    With a set-point comes how fast it moves, `MOVES`. Raises `PalpateError` where a channel is
    missing, is not of two numbers, or is in another unit.
    """
    trials = []
    for trial in recording.trials:
        channels = dict(trial.channels)
        for name, given in names.items():
            channels[name] = _of_two_numbers(trial, name, given, channels.get("position"))
        if "setpoint" in names and "position" in names:
            period = channels["position"].nominal_period
            channels[MOVES] = _moves(channels["setpoint"], period)
        trials.append(dataclasses.replace(trial, channels=channels))
    return dataclasses.replace(recording, trials=tuple(trials))


def _of_two_numbers(
    trial: Trial, name: str, given: Sequence[str], position: Channel | None
) -> Channel:
    role = Role.COMMAND if name in COMMANDS else Role.OBSERVATION
    numbers = [_number(text) for text in given]
    if position is not None and len(given) == 2 and None not in numbers:
        time = position.time[:1]
        return Channel(name, role, time, np.array([numbers], float), UNITS[name], axes="x y")
    parts = [trial[channel] for channel in given]
    for part in parts:
        if part.unit and part.unit != UNITS[name]:
            raise PalpateError(
                f"'{part.name}' of trial '{trial.name}' is in {part.unit}: expected {UNITS[name]}"
            )
    if len({part.time.tobytes() for part in parts}) > 1:
        raise PalpateError(
            f"{' and '.join(given)} of trial '{trial.name}' have different time stamps: expected "
            "both numbers of a vector at the same times"
        )
    values = np.concatenate([part.values.reshape(len(part.values), -1) for part in parts], axis=1)
    if values.shape[1] != 2:
        raise PalpateError(
            f"{' and '.join(given)} of trial '{trial.name}' are {values.shape[1]} numbers in a "
            f"frame: expected two, x and y of the {name}"
        )
    if name == "stiffness" and np.nanmin(values) < 0.0:
        raise PalpateError(
            f"the stiffness of trial '{trial.name}' is {np.nanmin(values):g} N/m at its least: "
            "expected none that is negative"
        )
    return dataclasses.replace(parts[0], name=name, role=role, values=values, unit=UNITS[name])


def _moves(setpoint: Channel, period: float) -> Channel:
    """How fast the set-point moves between frames of `period` s: of at least two orders in each.

    A frame's mean of orders does not say that it moved; an order for a whole frame stands still.
    """
    time, values = setpoint.time, setpoint.values
    moved = np.zeros_like(values)
    if 2.0 * setpoint.nominal_period < period * (1.0 + 1e-3):
        moved[:-1] = np.diff(values, axis=0) / np.diff(time)[:, None]
    return dataclasses.replace(setpoint, name=MOVES, values=moved, unit="m/s")


def directions_of(recording: Recording, degrees: Sequence[float]) -> Float[np.ndarray, " walls"]:
    """Where the walls face, rad: as given in `degrees`, else as the recording says.

    Raises `PalpateError` where neither says it, and for two walls that face alike.
    """
    fact = recording.fact(NORMALS, Quantity)
    if not degrees and fact is None:
        raise PalpateError(
            "the recording does not say where the walls face: expected --walls DEGREES, for each "
            "wall the direction in which it pushes the tip (0 is x, 90 is y, 180 is against x)"
        )
    recorded = np.asarray(fact and fact.values, float)
    angles = np.radians(degrees) if degrees else np.atleast_1d(recorded)
    for number, angle in enumerate(angles):
        if np.any(np.abs(_turn(angles[:number] - angle)) < 0.1):
            raise PalpateError(
                f"two walls face to {math.degrees(angle):.3g} degrees: expected walls that face "
                "differently, as the forces on the tip tell no others apart"
            )
    return angles


def starting_tip(aligned: Aligned, directions: Float[np.ndarray, " walls"]) -> Tip:
    """A tip between walls that are where the force along them begins to grow with depth.

    Raises `PalpateError` for a wall that is hardly ever felt.
    """
    position, force = aligned.observations["position"], aligned.observations["force"]
    seen = np.isfinite(position).all(axis=-1) & np.isfinite(force).all(axis=-1)
    places, forces = position[seen], force[seen]
    felt = np.linalg.norm(forces, axis=1) > _threshold(forces)
    towards = np.arctan2(forces[:, 1], forces[:, 0])
    found = []
    for angle in directions:
        own = felt & (np.abs(_turn(towards - angle)) < WIDE)
        if np.sum(own) < FEWEST:
            raise PalpateError(
                f"the wall that faces to {math.degrees(angle):.3g} degrees is felt in "
                f"{np.sum(own)} frames: expected at least {FEWEST}; forces of more than "
                f"{_threshold(forces):.2g} N point to {_common(towards[felt])} degrees: is the "
                "sign that of the force on the tip?"
            )
        # Not of the other walls, whose friction is as great as what a wall of its own pushes.
        alone, normal = own | ~felt, [math.cos(angle), math.sin(angle)]
        found.append(_onset(places[alone] @ normal, forces[alone] @ normal))
    return tip_with_walls(
        directions.tolist(),
        position=found,
        centre=places.mean(axis=0),
        control_period=aligned.period,
    )


def problems(aligned: Aligned) -> list[str]:
    """Sentences about recordings in which set-point and position cannot be of one tip."""
    said = []
    position = aligned.observations["position"]
    reach = float(np.nanmax(np.ptp(position[np.isfinite(position).all(-1)], axis=0)))
    if reach > LARGEST:
        said.append(
            f"the tip moves by {reach:.3g} m: expected at most {LARGEST:g} m, so the positions may "
            "not be in m"
        )
    first = position[:, 1:, :]
    off = np.nanmedian(np.linalg.norm(first - aligned.actions["setpoint"], axis=-1))
    if off > 0.5:
        said.append(
            f"the set-point is {off:.2g} m away from the tip in half of the frames: expected both "
            "in the same frame, in m"
        )
    return said


def _onset(along: Float[np.ndarray, " frames"], force: Float[np.ndarray, " frames"]) -> float:
    """Where a force that is none, and then grows with depth, begins: least squares, m.

    A tool that is accelerated pushes a sensor as a wall does, but wherever it is.
    """
    places = np.linspace(along.min(), along.max(), PLACES + 1)[1:]
    left = []
    for place in places:
        columns = np.stack([np.ones_like(along), np.maximum(0.0, place - along)], axis=1)
        left.append(np.sum(np.square(force - columns @ np.linalg.lstsq(columns, force)[0])))
    return float(places[np.argmin(left)])


def _threshold(forces: Float[np.ndarray, "frames 2"]) -> float:
    """N: what neither noise about a sensor's bias reaches nor a tool's inertia, 0.5 at least."""
    steps = np.diff(forces, axis=0)
    noise = float(np.median(np.abs(steps))) / 0.6745 / math.sqrt(2.0)
    great = float(np.quantile(np.linalg.norm(forces, axis=1), 0.95))
    return max(0.5, FEELS * noise, PRESSES * great)


def _common(angles: np.ndarray) -> str:
    """The most frequent directions, in tens of degrees."""
    tens = np.round(np.degrees(angles) / 10.0).astype(int) * 10 % 360
    values, counts = np.unique(tens, return_counts=True)
    return ", ".join(str(value) for value in values[np.argsort(-counts)][:3]) or "no"


def _turn(angle: np.ndarray) -> np.ndarray:
    """The same directions between -pi and pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
