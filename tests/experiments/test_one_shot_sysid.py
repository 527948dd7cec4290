"""mujoco.sysid as a rival: what it is told about casters, what it finds, and what it predicts."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import sysid

from palpate.errors import PalpateError
from palpate.experiments.rivals.furniture_scene import (
    ToldScene,
    caster_angles,
    caster_tracks,
    rolling_state,
    settled_positions,
)
from palpate.experiments.rivals.mujoco_sysid import KNOWN, SysidFit, fit_scene, predict_pieces
from palpate.identification.data.segments import cut
from palpate.models.planar import furniture
from palpate.worlds.furniture.furniture import (
    CONTROL_PERIOD,
    FurnitureSensors,
    FurnitureWorld,
    Piece,
)
from palpate.worlds.furniture.handling import record_handling, record_pushes
from palpate.worlds.furniture.pieces import KINDS

PERFECT = FurnitureSensors(0.0, 0.0, 0.0, 0.0, 0.0)


def world_of(kind, **settings):
    return FurnitureWorld([Piece(kind)], sensors=PERFECT, **settings)


def test_the_mass_is_found_from_a_few_seconds_without_noise():
    kind = KINDS["cart"]
    world = world_of("cart")
    recording = record_handling(world, seed=5, duration=4.0)
    true = world.truth().parameters[0]
    fit = fit_scene(recording, kind, true.locked, true.anchor)
    assert fit.converged
    assert fit.parameters.mass == pytest.approx(true.mass, rel=0.02)
    assert (fit.parameters.locked, fit.parameters.anchor) == (true.locked, true.anchor)


def test_a_caster_beside_a_hinge_need_not_show_where_it_points():
    world = world_of("hinged")
    recording = record_handling(world, seed=30, duration=6.0)
    true = world.truth().parameters[0]
    scene = ToldScene(KINDS["hinged"], true.locked, true.anchor, (0.0, 0.0, 0.0))
    aligned = recording.align(CONTROL_PERIOD)
    known = [known for _, known in caster_tracks(scene, aligned.observation[0, :, 0])]
    assert max(known[2]) < KNOWN
    fit = fit_scene(recording, KINDS["hinged"], true.locked, true.anchor)
    assert fit.parameters.mass == pytest.approx(true.mass, rel=0.1)


def predicted_pushes(kind, draws):
    """With the true constants, from the exact start; and the pieces."""
    world = world_of(kind)
    aligned = record_pushes(world, seed=2, count=3).align(CONTROL_PERIOD)
    true = world.truth().parameters[0]
    scene = ToldScene(KINDS[kind], true.locked, true.anchor, (0.0, 0.0, 0.0))
    model = furniture([np.asarray(KINDS[kind].outline)], control_period=CONTROL_PERIOD)
    segments = cut(aligned, model, 2.0, at_rest=True)
    exact = jnp.asarray(aligned.observation[:, 0], jnp.float32)
    segments = dataclasses.replace(segments, pose=exact)
    return predict_pieces(SysidFit(scene, true, True), segments, draws), segments


def test_with_the_true_constants_a_sliding_piece_is_predicted_to_the_micrometre():
    predicted, segments = predicted_pushes("couch", draws=1)
    assert predicted.shape == segments.target.shape == (3, 100, 1, 3)
    np.testing.assert_allclose(predicted, segments.target, atol=2e-5)


def test_where_casters_point_is_averaged_over():
    predicted, segments = predicted_pushes("hinged", draws=4)
    start, end = np.asarray(segments.pose), np.asarray(segments.target[:, -1])
    error = ((predicted[:, -1] - end)[..., :2] ** 2).sum()
    assert 0 < error < 0.03 * ((end - start)[..., :2] ** 2).sum()
    np.testing.assert_array_equal(predicted, predicted_pushes("hinged", draws=4)[0])


def test_a_dragged_caster_follows_the_tractrix():
    trail, path = 0.05, 0.01
    way = np.zeros((30, 3))
    way[:, 0] = path * np.arange(30)
    angle, known = caster_angles(way, (0.3, 0.2), trail)
    assert known[0] == pytest.approx(0, abs=1e-9)  # nothing is known before it is dragged
    assert np.diff(known).min() > -1e-9
    assert known[-1] > 0.98
    assert angle[-1] == pytest.approx(0, abs=0.01)  # behind a body that goes along its x axis
    turned = way + np.array([0, 0, 0.5])  # a body that goes obliquely
    assert caster_angles(turned, (0.3, 0.2), trail)[0][-1] == pytest.approx(-0.5, abs=0.01)


def test_a_caster_on_a_circle_points_at_a_tangent_less_its_trail():
    # The wheel's axle passes through the middle of the circle: sin(lag) = trail / radius.
    trail, radius = 0.03, 0.2
    way = np.zeros((1000, 3))
    way[:, 2] = 0.005 * np.arange(1000)
    angle, known = caster_angles(way, (radius, 0.0), trail)
    assert known[-1] == pytest.approx(1, abs=1e-6)
    assert angle[-1] == pytest.approx(np.pi / 2 - np.arcsin(trail / radius), abs=0.01)


def test_casters_of_the_world_point_where_the_way_says():
    world = world_of("table")
    recording = record_handling(world, seed=3, duration=6.0)
    true = world.truth().parameters[0]
    scene = ToldScene(KINDS["table"], true.locked, None, (0.0, 0.0, 0.0))
    tracks = caster_tracks(scene, recording.trials[0]["pose"].values[:, 0])
    running = world._now()
    for number, (angle, known) in zip(scene.free, tracks, strict=True):
        # Casters that start anywhere are where they were seen to be dragged to.
        joint = running.data.joint(f"table wheel {number} swivel")
        fork = running.model.body(f"table wheel {number} fork").quat
        swivel = joint.qpos[0] + 2 * np.arctan2(fork[3], fork[0])
        assert known[-1] > 0.98
        assert abs(np.angle(np.exp(1j * (swivel - angle[-1])))) < 0.2


def test_wheels_begin_to_roll_without_slipping():
    """The middle of each wheel moves along the wheel alone, at its rate of rolling."""
    kind = KINDS["cart"]
    scene = ToldScene(kind, (None,) * 4, None, (0.0, 0.0, 0.3))
    model = scene.model(*[0.5] * 5)
    # About a point on the line of the fixed wheels' axles, 0.9 m from the body's origin.
    pose, turn, back = np.array([1.0, 2.0, 0.5]), 0.7, kind.mounts[0].place[0]
    velocity = turn * np.array([0.9, -back])
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    rate = np.array([*(np.array([[cosine, -sine], [sine, cosine]]) @ velocity), turn])
    settled = settled_positions(model)
    angles = np.array([0.4, -1.1])
    state = rolling_state(sysid, scene, model, settled, pose, rate, angles)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(model, data)
    moved = np.empty(6)
    for number, mount in enumerate(kind.mounts):
        name = f"body wheel {number}"
        wheel = mujoco.mjtObj.mjOBJ_BODY
        mujoco.mj_objectVelocity(model, data, wheel, model.body(name).id, moved, 1)
        rolled = mount.radius * data.joint(f"{name} roll").qvel[0]
        assert moved[3:5] == pytest.approx([rolled, 0], abs=2e-3)
        assert abs(rolled) > 0.1


def test_what_cannot_be_fitted_is_said(monkeypatch):
    recording = record_handling(world_of("couch"), seed=1, duration=1.0)
    feet = (None,) * 4
    with pytest.raises(PalpateError, match="bolted down"):
        fit_scene(recording, KINDS["bolted"], ())
    two = FurnitureWorld([Piece("box"), Piece("box", (2, 0, 0))])
    with pytest.raises(PalpateError, match="one piece"):
        fit_scene(record_handling(two, seed=1, duration=1.0), KINDS["box"], feet)
    short = record_pushes(world_of("couch"), seed=1, count=1, duration=0.2)
    with pytest.raises(PalpateError, match="trial 'push 0 couch' is shorter than 21 frames"):
        fit_scene(short, KINDS["couch"], feet)
    still = record_pushes(world_of("chair"), seed=1, count=1, duration=0.5)
    with pytest.raises(PalpateError, match="where its casters point"):
        fit_scene(still, KINDS["chair"], (None,) * 5)
    monkeypatch.delattr(sysid, "optimize")
    with pytest.raises(PalpateError, match=r"pip install 'palpate\[sysid\]'"):
        fit_scene(recording, KINDS["couch"], feet)


def test_parameters_and_shares_of_their_bounds_are_the_same_thing():
    couch, table = (
        ToldScene(KINDS[kind], (None,) * 4, None, (0.0, 0.0, 0.0)) for kind in ("couch", "table")
    )
    assert "rolling resistance" not in couch.bounds  # feet do not roll
    shares = [0.1, 0.2, 0.3, 0.4, 0.5]
    parameters = table.parameters(*shares)
    assert table.shares(parameters) == pytest.approx(shares)
    assert dataclasses.replace(parameters, locked=(None,) * 4) == parameters
    middle, width = table.prior
    usual = table.parameters(*(middle + width).tolist())
    assert usual.mass == pytest.approx(1.3 * KINDS["table"].mass)
    assert usual.load_place == pytest.approx((0.3, 0.175))
    assert usual.friction == pytest.approx(KINDS["table"].friction[1])
    assert usual.rolling_resistance == pytest.approx(KINDS["table"].rolling_resistance[1])
