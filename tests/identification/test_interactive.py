"""A door and a drawer of plain boxes, handled by known motions: what the twin finds of them."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.errors import PalpateError
from palpate.identification.interactive import labels
from palpate.identification.interactive import twin as twin_module
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.labels import SMOOTH, evidence, smooth_labels
from palpate.identification.interactive.refinement import refine, sighting
from palpate.identification.interactive.screws import NOWHERE, Screw
from palpate.identification.interactive.twin import Twin
from palpate.learning.active import CHOICES, WORTHS, _tries
from palpate.learning.movable_guess import MovableGuess, load_guess
from palpate.learning.repeats import FORCES, Repeat
from palpate.models.articulated.assembly import assemble
from palpate.models.articulated.urdf import read_urdf, write_urdf
from palpate.perception.clouds import Cloud, cloud_of
from palpate.trials.appliance.hand import handle
from palpate.trials.appliance.interaction import interact
from palpate.trials.appliance.score import difference, figures_of, score
from palpate.worlds.appliance.appliance import ApplianceWorld

INFORMATION = WORTHS["information"]
QUIET = 3  # the seed of a microwave with a door and a drawer


@pytest.fixture(scope="module")
def handled():
    """A microwave whose door a hand has pulled, where it tells the most."""
    world = ApplianceWorld("microwave", 1)
    world.reset(1, position=[0.2])
    twin = Twin()
    truth = world.truth()
    twin.look(cloud_of(world.look()))
    labels = world.truth().labels
    source = twin.looks[0].source
    mine = np.array([labels[image][row, column] for image, row, column in source]) == 0
    points = twin.looks[0].points[mine]
    arms = np.cross(truth.axis[0], points - truth.anchor[0])
    far = np.argsort(np.linalg.norm(arms, axis=1))[int(0.8 * len(arms))]
    way = arms[far] / np.linalg.norm(arms[far])
    for _ in range(4):  # a hand may get no hold
        handling = handle(world, Push(points[far], way), twin.looks[-1])
        after = world.truth()
        if handling.held:
            break
    return world, twin, handling, after


def test_a_hand_reaches_its_travel_and_says_so(handled):
    _, _, handling, _ = handled
    assert handling.moved
    assert 0.25 < handling.travel < 0.45
    assert len(handling.times) == len(handling.points) == len(handling.forces)
    assert np.linalg.norm(handling.forces, axis=1).max() < 41.5


def test_the_door_is_found_with_its_axis_and_its_points(handled):
    world, twin, handling, after = handled
    twin = _copy(twin)
    twin.observe(handling)
    assert [part.screw.joint for part in twin.parts] == ["revolute"]
    angle, gap = difference(twin.screw(0, 1), after.axis[0], after.anchor[0])
    assert angle < 1.5
    assert gap < 1.0
    mine = np.array(
        [after.labels[image][row, column] for image, row, column in twin.looks[1].source]
    )
    overlap = np.sum((mine == 0) & (twin.labels[1] == 0)) / np.sum(
        (mine == 0) | (twin.labels[1] == 0)
    )
    assert overlap > 0.8
    assert world.parts[0].joint == "revolute"


def test_the_order_of_points_does_not_matter(handled):
    _, twin, handling, _ = handled
    found = []
    for seed in (None, 0):
        other = _copy(twin)
        before, after = handling.before, handling.after
        if seed is not None:
            before, after = _shuffled(before, seed), _shuffled(after, seed)
            other.looks, other.labels = [before], [np.full(len(before.points), -1)]
        other.observe(dataclasses.replace(handling, before=before, after=after))
        found.append(other.parts[0].screw)
    angle, gap = difference(found[0], found[1].axis, found[1].point)
    assert angle < 0.3  # other points are drawn for the fit
    assert gap < 0.2


def test_a_part_that_is_pushed_back_is_the_same_one(handled):
    _, twin, handling, _ = handled
    twin = _copy(twin)
    twin.observe(handling)
    back = dataclasses.replace(
        handling,
        before=handling.after,
        after=_shuffled(handling.before, 1),
        points=handling.points[::-1],
        push=dataclasses.replace(handling.push, point=handling.points[-1]),
    )
    twin.observe(back)
    assert len(twin.parts) == 1
    assert len(twin.parts[0].ways) == 2
    assert [part for part, _ in twin.held] == [0, 0]
    positions = twin.parts[0].positions
    assert positions[2] == pytest.approx(positions[0], abs=0.03)
    assert abs(positions[1] - positions[0]) > 0.3


def test_a_part_that_explains_nothing_is_not_kept(handled):
    _, twin, handling, _ = handled
    twin = _copy(twin)
    away = dataclasses.replace(handling, points=handling.points + np.array([0.0, 0.0, 3.0]))
    # the hand went its way above the appliance, where nothing was seen to move
    twin.observe(dataclasses.replace(away, after=_shuffled(handling.before, 2)))
    assert not twin.parts
    assert twin.held == [(-1, 0)]


def test_a_part_that_goes_leaves_the_others_as_they_are(handled):
    _, twin, handling, _ = handled
    twin = _copy(twin)
    twin.observe(handling)
    part = twin.parts[0]
    twin.parts += [dataclasses.replace(part, parent=0), dataclasses.replace(part, parent=1)]
    twin.labels = [np.array([-1, 0, 1, 2])]
    twin.held = [(2, 0), (1, 0)]
    twin.remove(1, 0)
    assert [one.parent for one in twin.parts] == [-1, 0]
    assert twin.labels[0].tolist() == [-1, 0, 0, 1]
    assert twin.held == [(1, 0), (0, 0)]


def test_an_action_is_kept_although_it_takes_a_part_out(handled, monkeypatch):
    monkeypatch.setattr(twin_module, "discover_pair", lambda *_: -1)  # no other account is sought
    _, seen, handling, _ = handled

    class Merging(Twin):
        def _explain(self, before, after, handling, **_):
            self.held = list(self.held)  # as a part that is taken out does
            return -1, False

    twin = Merging()
    twin.look(seen.looks[0])
    twin.observe(handling)
    assert len(twin.held) == len(twin.handled) == 1


def test_nothing_moved_adds_nothing(handled):
    _, twin, handling, _ = handled
    twin = _copy(twin)
    points = np.repeat(handling.points[:1], len(handling.points), axis=0)
    still = dataclasses.replace(handling, points=points, after=handling.before)
    twin.observe(still)
    assert not twin.parts
    nothing = np.zeros((0, 3))
    missed = dataclasses.replace(
        handling, times=np.zeros(0), points=nothing, forces=nothing, after=handling.before
    )
    assert not missed.held
    twin.observe(missed)
    assert not twin.parts


def test_evidence_tells_where_points_have_gone(handled):
    _, twin, handling, after = handled
    twin = _copy(twin)
    twin.observe(handling)
    cloud = twin.looks[0]
    mine = twin.labels[0] == 0
    right, wrong = twin.motion(0, 0, 1), NOWHERE
    for pose, better in ((right, True), (wrong, False)):
        value = evidence(
            twin.looks[1], pose.at(cloud.points[mine]), pose.turned(cloud.normals[mine])
        )
        assert (value.mean() > 0.0) == better
    assert after.position[0] > 0.2


def test_neighbours_on_a_surface_are_likely_of_one_part(handled, monkeypatch):
    cloud = handled[2].before
    given = np.zeros((2, len(cloud.points)))
    given[1, ::5] = 2.0
    chance = smooth_labels(cloud, given)
    assert np.allclose(chance.sum(axis=0), 1.0)
    assert chance[1].mean() > 0.6
    # three labels come to where the equation of the mean field holds
    monkeypatch.setattr(labels, "ROUNDS", 1000)
    monkeypatch.setattr(labels, "SETTLED", 1e-7)
    given = np.random.default_rng(0).normal(size=(3, len(cloud.points)))
    chance = smooth_labels(cloud, given)
    again = np.exp(given + SMOOTH * (cloud.surface_graph @ chance.T).T)
    np.testing.assert_allclose(chance, again / again.sum(axis=0), atol=1e-6)


def test_a_refined_joint_is_nearer_than_its_first_guess(handled):
    _, twin, handling, after = handled
    twin = _copy(twin)
    twin.observe(handling)
    part = twin.parts[0]
    seen = [sighting(twin.looks[look], part.seen[look], NOWHERE) for look in (0, 1)]
    true = Screw("revolute", after.axis[0], after.anchor[0])
    guess = true.varied(np.array([0.05, -0.04, 0.01, 0.01]))
    guess = dataclasses.replace(guess, axis=guess.axis * np.sign(guess.axis @ part.screw.axis))
    found = refine(guess, np.array(part.positions), seen, [(0, handling.points)])
    angle, gap = difference(found.screw, true.axis, true.point)
    assert angle < 1.5 < math.degrees(math.hypot(0.05, 0.04))
    assert gap < 1.0
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0)


def test_every_choice_points_at_something_that_was_seen(handled):
    twin = handled[1]
    for choose in CHOICES.values():
        push = choose(twin, np.random.default_rng(0))
        assert np.linalg.norm(push.direction) == pytest.approx(1.0)
        assert twin.looks[-1].tree.query(push.point)[0] < 1e-9


def test_a_long_way_tells_of_forces_and_less_each_time(handled):
    twin = _copy(handled[1])
    twin.observe(handled[2])
    part, screw = twin.parts[0], twin.screw(0, 1)
    point = screw.point + 0.4 * screw.across[0]

    def worth(gone: float, felt: int) -> float:
        pull = Repeat(part, screw, gone, point, felt, point[None], 0.1)
        return INFORMATION.of_repeat(pull)

    assert worth(0.5, 0) - worth(0.5, 1) == pytest.approx(0.75 * FORCES)
    assert worth(0.5, 1) > worth(0.5, 2)
    assert worth(0.1, 0) == pytest.approx(worth(0.1, 1))  # too short


class Even(MovableGuess):
    """Says of every surface that it rather moves."""

    def __call__(self, features: np.ndarray) -> np.ndarray:
        return np.full(len(features), 0.6)


def test_a_guess_that_was_wrong_is_trusted_less_beside_it(handled):
    twin, known = _copy(handled[1]), load_guess()
    guess = Even(known.mean, known.deviation, known.network)

    def values() -> list[float]:
        random, look = np.random.default_rng(0), len(twin.looks) - 1
        return sorted(value for value, _ in _tries(twin, look, random, guess, INFORMATION))

    before = values()
    cloud, times = twin.looks[-1], np.arange(5.0)
    place = cloud.points[np.argmax(cloud.points[:, 2])]
    still = place + np.zeros((5, 3))
    twin.observe(Handling(Push(place, np.eye(3)[2]), cloud, cloud, times, still, 0.0 * still))
    after = values()
    assert len(after) == len(before) > 2
    assert after[-1] < 0.95 * before[-1]  # that of a surface which nobody has tried


def test_a_part_that_is_hardly_seen_while_a_hand_pulls_in_vain_is_kept(handled):
    _, twin, handling, _ = handled
    twin = _copy(twin)
    twin.observe(handling)
    labels = twin.labels[-1]
    mine, points = np.flatnonzero(labels == 0), twin.looks[-1].points
    middle = np.linalg.norm(points[mine] - points[mine].mean(axis=0), axis=1).argsort()
    shown = np.sort(np.concatenate([np.flatnonzero(labels != 0), mine[middle[:10]]]))
    hidden, later = (_chosen(twin.looks[-1], shown) for _ in range(2))
    twin.look(hidden)
    place = hidden.points[np.flatnonzero(twin.labels[-1] == 0)[0]]
    nothing = np.zeros((5, 3))
    twin.observe(
        Handling(Push(place, np.eye(3)[0]), hidden, later, np.arange(5.0), place + nothing, nothing)
    )
    assert twin.held[-1][0] == 0
    assert len(twin.parts) == 1


def test_a_twin_becomes_a_file_that_can_be_read_again(handled, tmp_path):
    _, twin, handling, _ = handled
    with pytest.raises(PalpateError, match="no part was found that moves"):
        describe(twin, "microwave")
    twin = _copy(twin)
    twin.observe(handling)
    write_urdf(tmp_path / "twin.urdf", describe(twin, "microwave"))
    links = assemble(read_urdf(tmp_path / "twin.urdf")).links
    assert [link.joint for link in links] == ["revolute"]
    assert np.allclose(links[0].origin, twin.parts[0].screw.point, atol=1e-6)
    assert links[0].upper - links[0].lower > 0.4
    assert links[0].mass > 0.05


def test_an_appliance_is_handled_until_its_parts_are_known():
    world = ApplianceWorld("microwave", QUIET)
    world.reset(QUIET)
    twin = Twin()
    for step in interact(world, CHOICES["information"], 4, QUIET):
        twin = step.twin
        assert step.seconds > 0.0
    found = score(twin, world)
    assert found.found.mean() >= 0.5
    assert np.nanmax(found.degrees) < 3.0
    figures = {figure.name: figure.value for figure in figures_of([found])}
    assert figures["recall"] == found.found.mean()
    assert figures["precision"] == pytest.approx(
        found.found.sum() / (found.found.sum() + found.extra)
    )


def _copy(twin: Twin) -> Twin:
    """A twin that has looked once."""
    other = Twin()
    other.looks, other.labels = list(twin.looks[:1]), [twin.labels[0].copy()]
    return other


def _shuffled(cloud: Cloud, seed: int) -> Cloud:
    return _chosen(cloud, np.random.default_rng(seed).permutation(len(cloud.points)))


def _chosen(cloud: Cloud, order: np.ndarray) -> Cloud:
    return dataclasses.replace(
        cloud,
        points=cloud.points[order],
        normals=cloud.normals[order],
        deviation=cloud.deviation[order],
        source=cloud.source[order],
        tree=cKDTree(cloud.points[order]),
    )
