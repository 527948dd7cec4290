"""`palpate identify furniture`: what a recording has to bring, and the whole way on a short one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.cli import main
from palpate.errors import PalpateError
from palpate.families.furniture.options import IdentifyFurniture
from palpate.families.furniture.recording import (
    POSE,
    WRENCH,
    check_alike,
    names_of,
    prepare,
    prune_contacts,
    record_pieces,
    starting_furniture,
)
from palpate.families.furniture.structures import joints, structures
from palpate.identification.posterior.comparison import begins_at_rest
from palpate.recordings import Channel, Labels, Polygons, Quantity, Recording, Role, Trial
from palpate.recordings.facts import Fact

RATE = 50.0


def recording(pose: np.ndarray, wrench: np.ndarray, **facts: Fact) -> Recording:
    time = np.arange(len(pose)) / RATE
    channels = {
        POSE: Channel(POSE, Role.OBSERVATION, time, pose, "m, m, rad"),
        WRENCH: Channel(WRENCH, Role.COMMAND, time[:-1], wrench, "N, N, N m"),
    }
    return Recording((Trial("one", channels, facts=facts),), {})


def still(bodies: int = 1, frames: int = 20) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    noise = 1e-3 * random.standard_normal((frames, bodies, 3))
    return noise, np.zeros((frames - 1, bodies, 3))


def test_one_body_may_come_without_an_axis_of_its_own():
    pose, wrench = still()
    found = prepare(recording(pose[:, 0], wrench[:, 0]))
    assert found.trials[0][POSE].values.shape == (20, 1, 3)
    assert names_of(found) == ("body 1",)


def test_channels_of_another_shape_are_refused():
    pose, wrench = still(2)
    with pytest.raises(PalpateError, match="expected \\(frames, bodies, 3\\)"):
        prepare(recording(pose[..., :2], wrench))
    with pytest.raises(PalpateError, match="the same bodies"):
        prepare(recording(pose, wrench[:, :1]))


def test_outlines_come_from_the_recording_or_from_a_size():
    pose, wrench = still()
    corners = [[-0.6, -0.3], [0.6, -0.3], [0.6, 0.3], [-0.6, 0.3]]
    outlines = Polygons((np.array(corners),), ("table",), "body")
    whole = prepare(recording(pose, wrench, bodies=Labels(("table",)), outlines=outlines))
    half_extent = np.asarray(starting_furniture(whole, 0.02).half_extent)
    np.testing.assert_allclose(half_extent, [[0.6, 0.3]], rtol=1e-6)
    bare = prepare(recording(pose, wrench))
    with pytest.raises(PalpateError, match="--size LENGTH WIDTH"):
        starting_furniture(bare, 0.02)
    sized = starting_furniture(bare, 0.02, (1.2, 0.6))
    np.testing.assert_allclose(np.asarray(sized.half_extent), half_extent, rtol=1e-6)
    with pytest.raises(PalpateError, match="two positive lengths"):
        starting_furniture(bare, 0.02, (1.2, -1.0))


def test_names_are_those_of_the_bodies_in_the_channels():
    pose, wrench = still()
    with pytest.raises(PalpateError, match="expected names of its 1 bodies"):
        names_of(prepare(recording(pose, wrench, bodies=Labels(("a", "b")))))
    with pytest.raises(PalpateError, match='"bodies" are Quantity: expected Labels'):
        names_of(prepare(recording(pose, wrench, bodies=Quantity(np.array(2.0), "1"))))


def test_a_body_that_is_never_seen_is_refused():
    pose, wrench = still()
    with pytest.raises(PalpateError, match="never seen"):
        starting_furniture(prepare(recording(np.full_like(pose, np.nan), wrench)), 0.02, (1.0, 1.0))


def test_only_the_hinged_hypothesis_has_a_link():
    pose, wrench = still()
    models = structures(prepare(recording(pose, wrench)), 0.02, (1.0, 0.5))
    assert set(models) == {"wheels", "feet", "hinge", "bolted"}
    alike = [jax.tree.map(jnp.shape, models[name]) for name in ("wheels", "feet", "bolted")]
    assert alike[0] == alike[1] == alike[2]
    assert [name for name, model in models.items() if model.link_to.size] == ["hinge"]
    assert float(models["hinge"].pivot.sum()) == 1.0
    assert float(models["feet"].wheel.sum()) == 0.0


def test_angles_may_be_wrapped():
    pose, wrench = still(2)
    pose[..., 2] += np.pi
    pose[14:17, 1] = np.nan
    wrapped = pose.copy()
    wrapped[..., 2] = (wrapped[..., 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.nanmax(np.abs(np.diff(wrapped[..., 2], axis=0))) > 6
    found = prepare(recording(wrapped, wrench))
    turned = (found.trials[0][POSE].values - pose)[..., 2]
    np.testing.assert_allclose(np.nanmax(turned, axis=0), np.nanmin(turned, axis=0), atol=1e-9)
    assert not joints(found)  # nothing has moved
    model = starting_furniture(found, 0.02, (1.0, 0.5))
    assert begins_at_rest(found.align(0.02), model)


def test_what_may_be_is_asked_of_recordings_of_the_same_bodies():
    far, near = two_boxes(np.full(20, 2.0)), two_boxes(np.full(20, 0.1))
    options = IdentifyFurniture(recordings=(), structure="feet")
    (model,) = options.hypotheses([far, near], far.align(1 / RATE)).models.values()
    assert len(model.pairs) == 3
    assert len(options.sufficient(model, [far]).pairs) == 0
    assert len(options.sufficient(model, [far, near]).pairs) == 1
    with pytest.raises(PalpateError, match="expected the same bodies"):
        options.reference([far, prepare(recording(*still()))], far.align(1 / RATE))


def test_rest_is_told_from_motion():
    pose, wrench = still()
    model = starting_furniture(prepare(recording(pose, wrench)), 0.02, (1.0, 0.5))
    aligned = recording(pose, wrench).align(0.02)
    assert begins_at_rest(aligned, model)
    moving = pose + 0.5 * np.arange(len(pose))[:, None, None] / RATE
    assert not begins_at_rest(dataclasses.replace(aligned, observation=moving[None]), model)


def two_boxes(apart: np.ndarray, seen: np.ndarray | bool = True) -> Recording:
    """Two boxes of 1 m whose sides are so far `apart`, m; only the second is not always `seen`."""
    pose = np.zeros((len(apart), 2, 3))
    pose[:, 1, 0] = np.where(seen, 1.0 + apart, np.nan)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    facts = {
        "bodies": Labels(("a", "b")),
        "outlines": Polygons((corners, corners), ("a", "b"), "body"),
        "walls": Polygons((np.array([[-9.0, -9.0], [9.0, -9.0], [0.0, -8.0]]),)),
    }
    return recording(pose, np.zeros((len(apart) - 1, 2, 3)), **facts)


@pytest.mark.parametrize(("nearest", "touch"), [(0.2, True), (0.4, False)])
def test_only_what_comes_near_may_touch(nearest, touch):
    found = two_boxes(nearest + 0.1 * np.abs(np.arange(20.0) - 10.0))
    model = starting_furniture(found, 1 / RATE)
    assert len(model.pairs) == 3  # each with the other and with the wall
    assert prune_contacts(model, found).pairs.tolist() == ([[0, 0, 1, 0]] if touch else [])


def test_between_frames_a_body_is_on_a_straight_way():
    frames = np.arange(20)
    passing = two_boxes(np.linspace(-4.0, 2.0, 20), (frames < 3) | (frames > 16))
    back = two_boxes(np.linspace(-4.0, 2.0, 20), frames < 3)
    model = starting_furniture(passing, 1 / RATE)
    assert len(prune_contacts(model, passing).pairs) == 1
    assert len(prune_contacts(model, back).pairs) == 0


def test_what_meets_in_any_recording_may_touch():
    far, near = two_boxes(np.full(20, 2.0)), two_boxes(np.full(20, 0.1))
    model = starting_furniture(far, 1 / RATE)
    assert len(prune_contacts(model, far).pairs) == 0
    assert len(prune_contacts(model, far, near).pairs) == 1
    nowhere = two_boxes(np.full(20, 2.0), False)
    assert len(prune_contacts(model, far, nowhere).pairs) == 3


def test_recordings_of_other_bodies_are_not_scored():
    pose, wrench = still(2)
    two = prepare(recording(pose, wrench, bodies=Labels(("a", "b"))))
    check_alike(two, prepare(recording(pose, wrench)))
    with pytest.raises(PalpateError, match="of a, b and of body 1: expected the same bodies"):
        check_alike(two, prepare(recording(pose[:, :1], wrench[:, :1])))
    with pytest.raises(PalpateError, match="of a, b and of b, a"):
        check_alike(two, prepare(recording(pose, wrench, bodies=Labels(("b", "a")))))


def test_recorded_pieces_bring_what_identification_needs():
    found = record_pieces(("table", "chair"), 3, 2, 0.2, pushes=False)
    assert [trial.name for trial in found.trials] == [
        "handling table 1",
        "handling chair 1",
        "handling table 2",
        "handling chair 2",
    ]
    model = starting_furniture(prepare(found), 0.02)
    assert model.bodies == 2
    pushed = record_pieces(("box",), 3, 2, 0.2, pushes=True)
    assert len(pushed.trials) == 2


@pytest.mark.slow
def test_a_table_is_identified_from_a_short_recording(tmp_path, capsys):
    file = tmp_path / "R.npz"
    assert main(["record", "furniture", "--duration", "3", "--out", str(file)]) == 0
    out = tmp_path / "identified"
    assert main(["identify", "furniture", str(file), "--draws", "50", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "mass" in told
    assert "90 % intervals hold" in told
    assert (out / "posterior.npz").exists()
    assert (out / "report.html").exists()
