"""Recordings as files of the Rerun viewer, to be looked at in space and time."""

from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import extra_module
from palpate.recordings.channel import Channel, Events
from palpate.recordings.recording import Recording
from palpate.runs.storage import write_bytes

PAUSE = 0.5  # s between trials
RADIUS = 0.005  # m of a point
TIMELINE = "time"


def write_rerun(path: str | Path, recording: Recording) -> None:
    """Write `recording` to a `.rrd` file; atomic.

    Trials follow one another on the timeline "time", half a second apart. A channel of points, in
    metres, is an entity of 3D points that has its name; what was not seen is not drawn. Any other
    channel is a plot. Events are clouds of points, if (points, 3) in metres, or images. The entity
    "trial" says which trial runs. A viewer plays it from its start.

    Raises `PalpateError` when rerun-sdk is missing or the file cannot be written.
    """
    rerun = extra_module("rerun", "viz", "rerun-sdk")
    stream = rerun.RecordingStream("palpate")
    memory = stream.memory_recording()
    stream.set_log_time_enabled(False)  # when the file was written is of no interest
    # A viewer would follow a recording to its end: this one plays, from the start, again and again.
    panel = rerun.blueprint.TimePanel(timeline=TIMELINE, play_state="playing", loop_mode="all")
    stream.send_blueprint(rerun.blueprint.Blueprint(panel, auto_layout=True, auto_views=True))
    stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for part in recording.trials[0].parts:
        if _is_points(part):
            stream.log(_entity(part), rerun.Points3D.from_fields(radii=RADIUS), static=True)
    begin = 0.0
    for trial in recording.trials:
        stream.set_time(TIMELINE, duration=begin)
        stream.log("trial", rerun.TextLog(trial.name))
        for channel in trial.channels.values():
            _send(stream, channel, channel.time - trial.start + begin)
        for events in trial.events.values():
            for time, array in zip(events.time - trial.start + begin, events.values, strict=True):
                stream.set_time(TIMELINE, duration=time)
                stream.log(_entity(events), _draw(events, array))
        begin += trial.duration + PAUSE
        if trial is not recording.trials[-1]:  # the last stays in view
            stream.set_time(TIMELINE, duration=begin - PAUSE)
            for part in trial.parts:
                stream.log(_entity(part), rerun.Clear(recursive=False))
    write_bytes(path, memory.drain_as_bytes())


def _entity(part: Channel | Events) -> str:
    from rerun import escape_entity_path_part

    return escape_entity_path_part(part.name)


def _is_points(part: Channel | Events) -> bool:
    return part.unit == "m" and part.values[0].shape[-1:] == (3,)


def _draw(events: Events, array: np.ndarray) -> Any:
    import rerun

    if _is_points(events):
        points = array.reshape(-1, 3)
        return rerun.Points3D(points[np.isfinite(points).all(axis=-1)])
    if array.ndim == 2:
        return rerun.DepthImage(array)
    if array.ndim == 3 and array.shape[2] in (3, 4):
        return rerun.Image(array)
    return rerun.Tensor(array)


def _send(stream: Any, channel: Channel, time: np.ndarray) -> None:
    import rerun

    values = channel.values.reshape(len(channel.values), -1)
    if _is_points(channel):
        points = channel.values.reshape(len(channel.values), -1, 3)
        seen = np.isfinite(points).all(axis=-1)
        columns = rerun.Points3D.columns(positions=points[seen]).partition(seen.sum(axis=1))
    else:
        columns = rerun.Scalars.columns(scalars=values.ravel()).partition(
            np.full(len(values), values.shape[1])
        )
    clock = rerun.TimeColumn(TIMELINE, duration=time)
    stream.send_columns(_entity(channel), indexes=[clock], columns=columns)
