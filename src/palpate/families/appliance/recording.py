"""Recordings of actions on an appliance: what depth cameras saw, and what a hand felt.

A trial is one action. Its channels are `HAND` (m) and `FORCE` (N) of a hand while it held on to
something, in the axes of the world. Its events are depth images (m, NaN where nothing was seen) of
one camera or more, "depth 1" and so on: before the action, at its end while the hand still holds
on, and, if there is a third, after it has let go. The facts "camera 1" and "camera 1 pose" say what
each camera is and where it is: the latter is (4, 4), from its frame (x right, y down, z forward) to
the world's, or (images, 4, 4) of a camera that moves.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from palpate.errors import PalpateError
from palpate.identification.interactive.forces.dynamics import Dynamics, dynamics_of
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.hindsight import reconsider
from palpate.identification.interactive.registration import exact_poses
from palpate.identification.interactive.twin import Twin
from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.perception.clouds import Cloud, cloud_of
from palpate.recordings import Channel, Events, Intrinsics, Quantity, Recording, Role, Trial

HAND, FORCE = "hand position", "hand force"
LOOKS = 2, 3  # of an action, at least and at most
LARGEST = 5.0  # m: a hand that goes further is in another unit


@dataclasses.dataclass(frozen=True, eq=False)
class ApplianceTwin(Recording):
    """Joint positions and forces of a twin that was made of actions, with the twin."""

    twin: Twin
    dynamics: Dynamics

    @property
    def notes(self) -> tuple[str, ...]:
        return (*super().notes, *self.dynamics.warnings)


def recording_of(
    handlings: Sequence[Handling], last: Cloud, about: dict[str, str | int]
) -> Recording:
    """Actions as a recording; `last` is what was seen after them.

    Those without a hold are left out: nothing was felt. Raises `PalpateError` where none had one.
    """
    kept = [one for one in handlings if one.held]
    if not kept:
        raise PalpateError("no hand got hold of anything: nothing was felt; try another seed")
    trials = []
    for number, one in enumerate(kept, 1):
        looks = [one.before, one.after, *([last] if one is kept[-1] else [])]
        end = float(one.times[-1])
        times = [float(one.times[0]), end, end + 1.0][: len(looks)]
        channels = (
            Channel(HAND, Role.OBSERVATION, one.times, one.points, "m"),
            Channel(FORCE, Role.OBSERVATION, one.times, one.forces, "N"),
        )
        images = zip(*(look.images for look in looks), strict=True)
        trials.append(trial_of(f"action {number}", channels, times, list(images)))
    return Recording(tuple(trials), about)


def trial_of(
    name: str,
    channels: Sequence[Channel],
    times: Sequence[float],
    cameras: Sequence[Sequence[DepthImage]],
) -> Trial:
    """An action: what the hand felt, and what was seen at `times` (s).

    `cameras` have of each camera an image for each of the times, all of one pinhole, wherever that
    was.
    """
    events, facts = [], {}
    for number, images in enumerate(cameras, 1):
        depths = [image.depth.astype(np.float32) for image in images]
        events.append(Events(f"depth {number}", np.array(times), depths, "m"))
        of, poses = images[0].pinhole, np.tile(np.eye(4), (len(images), 1, 1))
        for pose, image in zip(poses, images, strict=True):
            pose[:3, :3], pose[:3, 3] = image.pinhole.world_from_camera, image.pinhole.position
        moves = not np.allclose(poses, poses[0])
        facts[f"camera {number}"] = Intrinsics(of.width, of.height, of.focal, of.centre)
        facts[f"camera {number} pose"] = Quantity(poses if moves else poses[0], "")
    return Trial(
        name, {each.name: each for each in channels}, {each.name: each for each in events}, facts
    )


def twin_of(recording: Recording) -> ApplianceTwin:
    """The twin that a recording's actions make, and what was felt of its joints.

    Poses of cameras that have moved are made exact by what both looks show. Raises `PalpateError`
    for a recording that lacks what this module describes, in which no part was found to move, or
    none by itself.
    """
    twin, first = Twin(), _images(recording.trials[0])[0]
    for trial in recording.trials:
        looks: list[Cloud] = []
        for images in _images(trial):
            moved = twin.looks and _has_moved(images, first)
            earlier = [*twin.looks[:1], *twin.looks[-1:], *looks]
            looks.append(cloud_of(exact_poses(images, earlier) if moved else images))
            if not twin.looks:
                twin.look(looks[0])
        before, after, *released = looks
        twin.observe(_handling(trial, before, after))
        if released:
            twin.look(released[0])
    twin = reconsider(twin)
    known = dynamics_of(twin)
    about = {**recording.provenance, "parts": len(twin.parts)}
    return ApplianceTwin(known.recording.trials, about, twin, known)


def _handling(trial: Trial, before: Cloud, after: Cloud) -> Handling:
    points, forces = _three(trial, HAND, "m"), _three(trial, FORCE, "N")
    if points.time.shape != forces.time.shape or not np.allclose(points.time, forces.time):
        raise PalpateError(
            f"'{HAND}' and '{FORCE}' of trial '{trial.name}' have different time stamps: expected "
            "both at the same times"
        )
    reach = float(np.linalg.norm(np.ptp(points.values, axis=0)))
    if reach > LARGEST:
        raise PalpateError(
            f"the hand of trial '{trial.name}' goes {reach:.3g} m: expected at most {LARGEST:g}; "
            "are the positions in m?"
        )
    mean = forces.values.mean(axis=0)
    size = float(np.linalg.norm(mean))
    direction = mean / size if size > 0.0 else np.array([1.0, 0.0, 0.0])
    strength = float(np.linalg.norm(forces.values, axis=1).max())
    push = Push(points.values[0], direction, "hold", strength, max(reach, 1e-3))
    return Handling(push, before, after, points.time, points.values, forces.values)


def _three(trial: Trial, name: str, unit: str) -> Channel:
    channel = trial[name]
    if channel.values.shape[1:] != (3,) or channel.unit not in ("", unit):
        raise PalpateError(
            f"'{name}' of trial '{trial.name}' has {channel.values[0].size} numbers in "
            f"'{channel.unit}': expected x, y and z in {unit}"
        )
    if np.isnan(channel.values).any():
        raise PalpateError(
            f"'{name}' of trial '{trial.name}' has moments that are NaN: expected the hand to be "
            "known as long as it holds on; cut the trial there"
        )
    return dataclasses.replace(channel, values=channel.values.astype(np.float64))


def _has_moved(images: Sequence[DepthImage], first: Sequence[DepthImage]) -> bool:
    """Whether a camera is not where it was in the first look, or another one sees.

    Where it looks may differ: clouds of points are seen by cameras that look at their middles.
    """
    places = [[image.pinhole.position for image in look] for look in (images, first)]
    return len(images) != len(first) or not np.allclose(*places, rtol=0.0, atol=1e-6)


def _images(trial: Trial) -> list[list[DepthImage]]:
    """What its cameras show, look by look."""
    cameras = list(_cameras(trial))
    if not cameras:
        raise PalpateError(
            f"trial '{trial.name}' has no depth images: expected events 'depth 1', with the facts "
            "'camera 1' and 'camera 1 pose'"
        )
    counts = {len(events.values) for events, _ in cameras}
    if len(counts) > 1 or not LOOKS[0] <= min(counts) <= LOOKS[1]:
        raise PalpateError(
            f"the cameras of trial '{trial.name}' have {', '.join(map(str, sorted(counts)))} depth "
            "images: expected of each one before the action, one at its end, and maybe one after"
        )
    return [
        [
            DepthImage(
                float(events.time[look]), pinholes[look], np.asarray(events.values[look], float)
            )
            for events, pinholes in cameras
        ]
        for look in range(counts.pop())
    ]


def _cameras(trial: Trial) -> Iterator[tuple[Events, list[Pinhole]]]:
    """The images of each camera, and its pinhole where it was in each."""
    number = 1
    while (name := f"depth {number}") in trial.events:
        of, pose = trial.facts.get(f"camera {number}"), trial.facts.get(f"camera {number} pose")
        if not isinstance(of, Intrinsics) or not isinstance(pose, Quantity):
            raise PalpateError(
                f"trial '{trial.name}' has '{name}' without a fact 'camera {number}' (intrinsics) "
                f"or 'camera {number} pose' (a quantity)"
            )
        events, matrices = trial.event(name), np.asarray(pose.values, float)
        count = len(events.values)
        if matrices.shape not in ((4, 4), (count, 4, 4)):
            raise PalpateError(
                f"'camera {number} pose' of trial '{trial.name}' has the shape {matrices.shape}: "
                f"expected (4, 4), from the camera's frame to the world's, or ({count}, 4, 4) of "
                "one that moves"
            )
        pinholes = []
        for matrix in np.broadcast_to(matrices, (count, 4, 4)):
            rows = tuple(map(tuple, matrix[:3, :3].tolist()))
            (x, y, z), (fx, fy), (cx, cy) = matrix[:3, 3].tolist(), of.focal, of.centre
            pinholes.append(Pinhole(of.width, of.height, (fx, fy), (cx, cy), (x, y, z), rows))
        yield events, pinholes
        number += 1
