"""Which bodies are joined: candidates from how they move, and the verdict of the evidence."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.families.furniture import structures as furniture_structures
from palpate.families.furniture.recording import POSE, WRENCH, one_body
from palpate.families.furniture.structures import hypotheses, joints, structures
from palpate.identification.posterior.comparison import posterior_of
from palpate.identification.posterior.laplace import CLIMBING, Modes, climb
from palpate.identification.posterior.likelihood import (
    MotionPosterior,
    initial_position,
    motion_posterior,
)
from palpate.identification.posterior.settled import Part, Settled
from palpate.models.model import rollout
from palpate.models.planar import furniture
from palpate.models.planar.shapes import rectangle
from palpate.models.planar.system import system_of
from palpate.recordings import Channel, Labels, Polygons, Recording, Role, Trial

PERIOD = 0.02
NOISE = np.array([5e-4, 5e-4, 1e-3])
BOX = rectangle(1.0, 0.6)
START = np.array([[0.0, 0.0, 0.3], [1.1, 0.3, 0.2]])
PLACE = np.array([0.55, 0.1])  # m, of the joint in the first body's frame


def pulled(joined: bool, seconds: float = 6.0) -> Recording:
    """The first of two boxes wiggled, the second with it or standing; then the second."""
    model = furniture(
        [BOX, BOX],
        wheels=0,
        pivots={0: 1} if joined else None,
        poses=START,
        link_anchor=PLACE / (0.5, 0.3) if joined else 0.0,
        mass=[12.0, 8.0],
        control_period=PERIOD,
    )
    time = PERIOD * np.arange(round(seconds / PERIOD))
    wave = np.stack([np.sin(2.1 * time), np.sin(1.3 * time), 0.4 * np.sin(1.7 * time)], axis=-1)
    random, trials = np.random.default_rng(0), []
    for held in range(2):
        wrench = np.zeros((len(time), 2, 3))
        wrench[:, held] = 40.0 * wave
        state = model.initial_state(jnp.asarray(np.stack([START, START])))
        poses = np.asarray(rollout(model, state, jnp.asarray(wrench)).pose)
        poses = np.concatenate([START[None], poses])
        poses += NOISE * random.standard_normal(poses.shape)
        stamps = PERIOD * np.arange(len(poses))
        channels = {
            POSE: Channel(POSE, Role.OBSERVATION, stamps, poses, "m, m, rad"),
            WRENCH: Channel(WRENCH, Role.COMMAND, stamps[:-1], wrench, "N, N, N m"),
        }
        trials.append(Trial(f"held {held}", channels, facts=outlined("cart", "trailer")))
    return Recording(tuple(trials), {})


def outlined(*names):
    """The facts that bodies of these names are boxes."""
    return {"bodies": Labels(names), "outlines": Polygons((BOX,) * len(names), names, "body")}


@pytest.fixture(scope="module")
def joined():
    return pulled(True)


def test_a_joint_is_where_one_point_of_both_stays_together(joined):
    ((pair, (on_first, on_second)),) = joints(joined).items()
    assert pair == (0, 1)
    np.testing.assert_allclose(on_first, PLACE, atol=5e-3)
    place = START[0, :2] + turned(PLACE, START[0, 2])
    np.testing.assert_allclose(on_second, turned(place - START[1, :2], -START[1, 2]), atol=5e-3)


def turned(point, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([cosine * point[0] - sine * point[1], sine * point[0] + cosine * point[1]])


def test_what_moves_apart_or_not_at_all_is_no_candidate(joined):
    assert not joints(pulled(False))
    one = one_body(joined, 0).trials[0]
    still = np.concatenate([one[POSE].values, 0.0 * one[POSE].values], axis=1)
    channels = {POSE: Channel(POSE, Role.OBSERVATION, one[POSE].time, still, "m, m, rad")}
    assert not joints(Recording((Trial("one", channels),), {}))


def at_a_mode(target, mass, likely):
    """A target at a mode with this mass, as probable as it is `likely`."""
    reference = target.coordinates.reference
    at = dataclasses.replace(reference, mass=jnp.array([mass]))
    target = motion_posterior(at, target.segments, target.scales)
    position = initial_position(target)[None]
    some = jnp.full(1, 1e3 * likely)
    modes = Modes(position, some, position, jnp.eye(position.shape[1])[None], some)
    return Settled(target, (Part(target, modes, np.arange(target.dimension)),))


def alone_is(first, second, monkeypatch):
    """Stand in for the verdict on each body; the models weigh 10 and 20 kg. What was looked at."""
    seen = []

    def explore(targets, seed):
        seen.append(next(iter(targets.values())).segments.count)
        kind, mass = ((first, 10.0), (second, 20.0))[len(seen) - 1]
        return {name: at_a_mode(target, mass, name == kind) for name, target in targets.items()}

    monkeypatch.setattr(furniture_structures, "explore", explore)
    # how likely anything is plays no part then, but takes a compilation for each kind of body
    monkeypatch.setattr(MotionPosterior, "linearised", lambda target, *_: target)
    return seen


def test_every_set_of_candidates_is_a_hypothesis_about_the_whole(joined, monkeypatch):
    seen = alone_is("feet", "bolted", monkeypatch)
    found = hypotheses(joined, PERIOD)
    models = found.models
    assert found.by_itself["cart"]["feet"] > 0.99
    assert found.by_itself["trailer"]["bolted"] > 0.99
    assert seen == [6, 6]  # pieces of two seconds
    apart, together = models.values()
    assert list(models) == [
        "cart: feet, trailer: bolted",
        "cart: wheels, trailer: wheels, cart joined to trailer",
    ]
    assert not apart.pivot.size
    np.testing.assert_array_equal(apart.mass, [10, 20])
    np.testing.assert_array_equal(together.mass, [10, 20])
    np.testing.assert_array_equal(apart.bolted, [0, 1])
    assert not apart.wheel.any()
    np.testing.assert_array_equal(together.pivot, [[1], [0]])
    np.testing.assert_array_equal(together.link_to, [[1], [-1]])
    assert together.wheel.all()
    np.testing.assert_allclose(
        together.link_anchor[0, 0] * together.half_extent[0], joints(joined)[0, 1][0], rtol=1e-5
    )


def test_a_joint_stays_where_both_bodies_were_seen(joined, monkeypatch):
    alone_is("feet", "feet", monkeypatch)
    late = joined.trials[0]
    pose = np.array(late[POSE].values)
    pose[: len(pose) // 2, 1] = np.nan  # the trailer comes into view when both have moved
    channels = dict(late.channels) | {POSE: dataclasses.replace(late[POSE], values=pose)}
    late = dataclasses.replace(late, channels=channels)
    seen = dataclasses.replace(joined, trials=(late, *joined.trials[1:]))
    _, whole = hypotheses(joined, PERIOD).models.values()
    alone_is("feet", "feet", monkeypatch)
    _, model = hypotheses(seen, PERIOD).models.values()
    on_other = [system_of(m).links.other_anchor[0, 0] for m in (whole, model)]
    np.testing.assert_allclose(on_other[1], on_other[0], atol=5e-3)


def test_a_hinge_gives_way_to_a_joint(joined, monkeypatch):
    alone_is("hinge", "hinge", monkeypatch)
    apart, together = hypotheses(joined, PERIOD).models.values()
    np.testing.assert_array_equal(apart.pivot, [[1], [1]])
    np.testing.assert_array_equal(apart.link_to, [[-1], [-1]])
    np.testing.assert_array_equal(together.pivot, [[1], [0]])


def test_a_hinge_is_where_the_body_stays_in_all_frames(joined):
    """And not where the noise of the first has it, which would be wrong at every moment."""
    model = furniture([BOX], wheels=0, pivots={0: None}, poses=START[:1], link_anchor=[-1.0, 0.4])
    wrench = np.zeros((200, 1, 3))
    wrench[:, 0, 2] = 20.0 * np.sin(1.7 * PERIOD * np.arange(200))
    state = model.initial_state(jnp.asarray(START[None, :1]))
    poses = np.asarray(rollout(model, state, jnp.asarray(wrench)).pose)
    poses = poses + NOISE * np.random.default_rng(1).standard_normal(poses.shape)
    poses[0] += (0.005, -0.005, 0.0)
    one = one_body(joined, 0)
    pose = dataclasses.replace(one.trials[0][POSE], time=PERIOD * np.arange(200), values=poses)
    still = dataclasses.replace(pose, values=np.repeat(poses[1:2], 200, axis=0))
    links = []
    for seen in (pose, still):
        trial = dataclasses.replace(one.trials[0], channels=one.trials[0].channels | {POSE: seen})
        hinged = structures(dataclasses.replace(one, trials=(trial,)), PERIOD)["hinge"]
        links.append((np.asarray(hinged.link_anchor[0, 0]), system_of(hinged).links.other_anchor))
    place = START[0, :2] + turned((-0.5, 0.12), START[0, 2])
    np.testing.assert_allclose(links[0][0] * (0.5, 0.3), (-0.5, 0.12), atol=2e-3)
    np.testing.assert_allclose(links[0][1][0, 0], place, atol=1e-3)
    np.testing.assert_allclose(links[1][0], 0.0, atol=1e-6)  # any point stays
    np.testing.assert_allclose(links[1][1][0, 0], poses[1, 0, :2], atol=1e-6)


def test_three_bodies_joined_all_round_share_out_their_pivots(joined):
    one = joined.trials[0]
    poses = np.concatenate([one[POSE].values, one[POSE].values[:, :1] + 2.0], axis=1)
    channels = {POSE: Channel(POSE, Role.OBSERVATION, one[POSE].time, poses, "m, m, rad")}
    three = Recording((Trial("one", channels),), {})
    round_about = {pair: (PLACE, PLACE) for pair in ((0, 2), (1, 2), (0, 1))}
    model = furniture_structures._together(
        three, PERIOD, (1.0, 0.6), 1, "coulomb", dict.fromkeys(range(3), "wheels"), round_about,
    )  # fmt: skip
    assert model.pivot.sum() == 3
    pairs = {frozenset((body, int(to))) for body, to in enumerate(model.link_to[:, 0])}
    assert pairs == set(map(frozenset, round_about))


@pytest.mark.slow
@pytest.mark.parametrize("are_joined", [True, False])
def test_evidence_tells_what_is_joined_from_what_only_may_be(are_joined, monkeypatch):
    seen = pulled(are_joined, 4.0)
    alone_is("feet", "feet", monkeypatch)
    where = (PLACE, np.array([-0.55, -0.1]))
    monkeypatch.setattr(furniture_structures, "joints", lambda recording: {(0, 1): where})
    models = hypotheses(seen, PERIOD).models
    apart, together = (evidence_of(model, seen) for model in models.values())
    assert (together > apart) == are_joined
    assert abs(together - apart) > 100.0


def standing() -> Recording:
    """A desk that is pushed and does not move, at an angle that jumps by a turn."""
    time = PERIOD * np.arange(200)
    random = np.random.default_rng(0)
    poses = np.array([[1.0, -0.5, np.pi]]) + NOISE * random.standard_normal((len(time), 1, 3))
    poses[..., 2] = (poses[..., 2] + np.pi) % (2 * np.pi) - np.pi
    wrench = np.stack([30.0 * np.sin(2.1 * time), 0.0 * time, 9.0 * np.sin(time)], axis=-1)[:, None]
    channels = {
        POSE: Channel(POSE, Role.OBSERVATION, time, poses, "m, m, rad"),
        WRENCH: Channel(WRENCH, Role.COMMAND, time[:-1], wrench[:-1], "N, N, N m"),
    }
    return Recording((Trial("one", channels, facts=outlined("desk")),), {})


def test_what_is_bolted_stands_at_the_mean_of_all_that_is_seen():
    seen = standing()
    model = structures(seen, PERIOD)["bolted"]
    frames = jnp.asarray(seen.trials[0][POSE].values[40:45])
    x, y, angle = np.asarray(model.initial_state(frames).pose)[0]
    deviation = NOISE / np.sqrt(200)
    assert np.all(np.abs([x - 1.0, y + 0.5, abs(angle) - np.pi]) < 4 * deviation)
    assert model.initial_state(frames).pose.tolist() == model.bolted_pose.tolist()


@pytest.mark.slow
def test_evidence_calls_what_stands_bolted_and_not_hinged():
    models = structures(standing(), PERIOD)
    bolted, hinged = (evidence_of(models[name], standing()) for name in ("bolted", "hinge"))
    assert bolted > hinged + 3.0


def evidence_of(model, recording):
    """At the top of one climb: the search from many starts is tested elsewhere, and takes long."""
    target = posterior_of(model, recording.align(PERIOD, POSE, WRENCH))
    start = initial_position(target)[None]
    return float(climb(target, start, CLIMBING).evidence[0])
