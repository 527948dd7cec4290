"""What energy a recorded wrench and motion drew, and how large a tank would have paid for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.recordings import Channel, Trial

UNITS = {"position": ("m", "rad"), "velocity": ("m/s", "rad/s"), "force": ("N", "N m", "N, N m")}
FEWEST = 3  # stamps


class RecordedEnergy(NamedTuple):
    """Of one trial, at the stamps of its force: (frames,) each but the name."""

    trial: str
    time: Float[np.ndarray, " frames"]  # s
    power: Float[np.ndarray, " frames"]  # W, out of the robot
    drawn: Float[np.ndarray, " frames"]  # J so far: the integral of it

    @property
    def given(self) -> float:
        """J that left the robot, without what came back."""
        return float(np.maximum(np.diff(self.drawn), 0.0).sum())

    @property
    def returned(self) -> float:
        """J that came back."""
        return float(np.maximum(-np.diff(self.drawn), 0.0).sum())

    @property
    def needed(self) -> float:
        """J that a tank without an upper bound had to hold in the beginning, so as never to be
        empty."""
        return float(max(0.0, self.drawn.max()))


def recorded_energy(
    trial: Trial, force: Sequence[str], motion: Sequence[str], on_robot: bool = True
) -> RecordedEnergy:
    """The energy that a trial's channels `force` drew, over what `motion` says.

    The numbers of several channels stand side by side. Forces, N, and torques, N m, are those on
    the robot (else, that the robot gives); `motion` are its positions, m or rad, or its velocities,
    of as many numbers in the same order. Positions are
    taken at the stamps of the force: its mean over a period times the way that was gone in it,
    exact for a force that changes evenly. Velocities are integrated by the trapezoidal rule.

    Raises `PalpateError` for channels that are no such thing, or that do not overlap.
    """
    forces, moves = ([trial[name] for name in names] for names in (force, motion))
    velocity = moves[0].unit in UNITS["velocity"]
    for kind, channels in (("force", forces), ("velocity" if velocity else "position", moves)):
        for channel in channels:
            if channel.unit and channel.unit not in UNITS[kind]:
                raise PalpateError(
                    f"'{channel.name}' of trial '{trial.name}' is in {channel.unit}: expected "
                    f"{' or '.join(UNITS[kind])}"
                )
    time = forces[0].time
    for channel in (*forces[1:], *moves):
        time = time[(time >= channel.time[0]) & (time <= channel.time[-1])]
    values, along = (
        np.concatenate([_at(channel, time) for channel in channels], axis=1)
        for channels in (forces, moves)
    )
    if values.shape != along.shape:
        raise PalpateError(
            f"{' '.join(force)} of trial '{trial.name}' have {values.shape[1]} numbers in a frame "
            f"and {' '.join(motion)} {along.shape[1]}: expected the same axes of both"
        )
    known = np.isfinite(values).all(axis=1) & np.isfinite(along).all(axis=1)
    time, values, along = time[known], values[known], along[known]
    if len(time) < FEWEST:
        raise PalpateError(
            f"{' '.join(force)} and {' '.join(motion)} of trial '{trial.name}' have {len(time)} "
            f"frames in common: expected at least {FEWEST}"
        )
    sign, steps = -1.0 if on_robot else 1.0, np.diff(time)
    mean = 0.5 * (values[:-1] + values[1:])
    if velocity:
        rate = np.sum(values * along, axis=1)
        gone = 0.5 * (rate[:-1] + rate[1:]) * steps
    else:
        gone = np.sum(mean * np.diff(along, axis=0), axis=1)
    drawn = sign * np.concatenate([[0.0], np.cumsum(gone)])
    power = np.gradient(drawn, time)
    return RecordedEnergy(trial.name, time - time[0], power, drawn)


def _at(
    channel: Channel, time: Float[np.ndarray, " frames"]
) -> Float[np.ndarray, "frames numbers"]:
    flat = channel.values.reshape(len(channel.time), -1).astype(float)
    return np.stack([np.interp(time, channel.time, column) for column in flat.T], axis=1)
