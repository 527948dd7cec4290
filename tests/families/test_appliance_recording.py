"""Actions on an appliance as a recording, and the twin that is made of it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate.commands import identify
from palpate.errors import PalpateError
from palpate.families.appliance.options import TWIN, IdentifyAppliance, RecordAppliance
from palpate.families.appliance.recording import FORCE, HAND, ApplianceTwin, twin_of
from palpate.identification.interactive.forces.action import POSITION
from palpate.models.articulated.urdf import read_urdf
from palpate.models.files import load_model
from palpate.recordings import Quantity, Recording
from palpate.recordings.files import read_recording, write_recording
from palpate.worlds.appliance.categories import draw_design

SEED = 600009  # of a microwave with one door


@pytest.fixture(scope="module")
def recording() -> Recording:
    return RecordAppliance(category="microwave", seed=SEED, trials=2).record()


@pytest.fixture(scope="module")
def known(recording) -> ApplianceTwin:
    return twin_of(recording)


def spoilt(recording, **changes):
    """The recording with a first trial whose parts are exchanged."""
    first = dataclasses.replace(recording.trials[0], **changes)
    return dataclasses.replace(recording, trials=(first, *recording.trials[1:]))


def changed(trial, name, **changes):
    return trial.channels | {name: dataclasses.replace(trial[name], **changes)}


def test_a_recording_makes_the_twin_that_was_handled(recording, known, tmp_path):
    (part,) = known.twin.parts
    assert part.screw.joint == "revolute"
    assert known.trials[0][POSITION].unit == "rad"
    (own,) = known.dynamics.resistance
    real = draw_design("microwave", SEED).parts[0].resistance
    assert own.friction == pytest.approx(real.friction, rel=0.2)
    write_recording(tmp_path / "R.npz", recording)
    again = twin_of(read_recording(tmp_path / "R.npz"))
    assert again.twin.parts[0].screw.axis == pytest.approx(part.screw.axis, abs=1e-4)
    assert again.dynamics.resistance[0].friction == pytest.approx(own.friction, rel=1e-2)


def test_a_camera_that_moves_is_where_its_images_say(recording, known):
    """Its poses at the end of the first action are off by 8 mm and 0.3 degrees."""
    trial, wrong = recording.trials[0], np.eye(4)
    wrong[:3, :3] = Rotation.from_rotvec(np.radians([0.2, -0.2, 0.1])).as_matrix()
    wrong[:3, 3] = 0.005, -0.006, 0.003
    facts = dict(trial.facts)
    for name in [name for name in facts if name.endswith("pose")]:
        pose = np.asarray(facts[name].values)
        facts[name] = Quantity(
            np.stack([pose, wrong @ pose, pose][: len(trial.event("depth 1").values)]), ""
        )
    found = twin_of(spoilt(recording, facts=facts)).twin
    moved, true = found.parts[0].screw, known.twin.parts[0].screw
    assert moved.joint == true.joint
    assert abs(moved.axis @ true.axis) > np.cos(np.radians(1.5))
    for mended, image in zip(found.looks[1].images, known.twin.looks[1].images, strict=True):
        points = found.looks[1].points[::50]
        pixels, depth = image.pinhole.project(points)
        missed = np.linalg.norm(mended.pinhole.back_project(pixels, depth) - points, axis=1)
        told = points @ wrong[:3, :3].T + wrong[:3, 3] - points
        assert missed.mean() < 0.7 * np.linalg.norm(told, axis=1).mean()
    first = facts["camera 1 pose"]
    facts["camera 1 pose"] = Quantity(np.asarray(first.values)[:, :3], "")
    with pytest.raises(PalpateError, match=r"expected \(4, 4\), from the camera's frame"):
        twin_of(spoilt(recording, facts=facts))


def test_what_is_missing_is_named(recording):
    trial = recording.trials[0]
    with pytest.raises(PalpateError, match="has no depth images: expected events 'depth 1'"):
        twin_of(spoilt(recording, events={}))
    with pytest.raises(PalpateError, match="'depth 1' without a fact 'camera 1'"):
        twin_of(spoilt(recording, facts={}))
    with pytest.raises(PalpateError, match=f"no channel '{HAND}'"):
        twin_of(spoilt(recording, channels={FORCE: trial[FORCE]}))
    values = trial[HAND].values.copy()
    values[3, 1] = np.nan
    with pytest.raises(PalpateError, match="moments that are NaN"):
        twin_of(spoilt(recording, channels=changed(trial, HAND, values=values)))
    far = 1e3 * trial[HAND].values
    with pytest.raises(PalpateError, match="are the positions in m"):
        twin_of(spoilt(recording, channels=changed(trial, HAND, values=far)))
    with pytest.raises(PalpateError, match=r"expected x, y and z in N"):
        twin_of(spoilt(recording, channels=changed(trial, FORCE, unit="kgf")))
    late = trial[FORCE].time + 0.5
    with pytest.raises(PalpateError, match="different time stamps"):
        twin_of(spoilt(recording, channels=changed(trial, FORCE, time=late)))
    events = {
        name: dataclasses.replace(one, time=one.time[:1], values=one.values[:1])
        for name, one in trial.events.items()
    }
    with pytest.raises(PalpateError, match="one before the action, one at its end"):
        twin_of(spoilt(recording, events=events))


def test_options_refuse_what_cannot_be():
    with pytest.raises(PalpateError, match="--validate is not for appliances"):
        IdentifyAppliance(recordings=(), validate=("R.npz",)).check()  # type: ignore[arg-type]
    with pytest.raises(PalpateError, match="1 to 60 s"):
        RecordAppliance(duration=0.1)


def test_the_command_leaves_a_model_and_a_twin(recording, tmp_path, capsys, one_horizon):
    write_recording(tmp_path / "R.npz", recording)
    options = IdentifyAppliance(
        recordings=(tmp_path / "R.npz",), out=tmp_path / "out", iterations=(2,)
    )
    folder = identify.run(options)
    model, _ = load_model(folder / "model.json")
    link = next(one for one in read_urdf(folder / TWIN).links if one.name != "body")
    assert link.inertial is not None
    assert link.inertial.mass == pytest.approx(float(model.mass[0]), rel=1e-4)
    assert (folder / "twin.png").is_file()
    assert "friction" in capsys.readouterr().out
