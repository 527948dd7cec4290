"""The Shopping-Cart and Apartment tasks and who learns them, at sizes that take seconds."""

import dataclasses
import itertools
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from shapely import affinity

from palpate.experiments.furniture import cart_online
from palpate.identification.data.segments import Segments
from palpate.models.planar import Planar, PlanarState
from palpate.planning.sampling import SamplingPlanner
from palpate.tasks.furniture.cart import (
    CLEAR,
    DONE,
    TURN,
    Turns,
    apartment,
    clearance,
    shopping_cart,
)
from palpate.trials.furniture import cart_controllers, cart_posterior, cart_trials
from palpate.trials.furniture.cart_controllers import (
    FRAMES,
    CartController,
    Decision,
    Episode,
    Handled,
    PhysicsController,
    Planning,
    RegressionController,
    around,
    due,
    piece_model,
    scene_model,
)
from palpate.trials.furniture.cart_posterior import PiecePosterior
from palpate.trials.furniture.cart_trials import best_scene, rewards_by_episode
from palpate.worlds.furniture.pieces import KINDS, draw_parameters

TASKS = [shopping_cart(), apartment()]
SMALL = Planning(samples=4, knots=3, spacing=1)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_starts_and_goals_are_apart_and_in_the_room(task):
    random = np.random.default_rng(1)
    walls = shapely.MultiPolygon([shapely.Polygon(wall) for wall in task.walls])
    for poses in (task.goals, *(task.start(random) for _ in range(200))):
        placed = [
            affinity.translate(affinity.rotate(shapely.Polygon(o), a, (0, 0), True), x, y)
            for o, (x, y, a) in zip(task.outlines, poses, strict=True)
        ]
        assert all(one.distance(walls) > 0.02 for one in placed)
        assert all(a.distance(b) > 0 for a, b in itertools.combinations(placed, 2))


def test_starts_of_the_apartment_stand_clear_whatever_the_seed():
    task = apartment()
    starts = [task.start(np.random.default_rng([seed, 8])) for seed in range(2000)]
    least = min(clearance(task.kinds, poses) for poses in starts)
    assert CLEAR < least < 2 * CLEAR  # some were drawn again
    assert clearance(task.kinds, np.zeros((3, 3))) == 0


def test_the_reward_is_distance_and_heading_the_short_way_round():
    task = shopping_cart()
    assert task.reward(task.goals) == 0
    assert task.reward(np.array([[3.0, 4.0, 2 * np.pi]])) == pytest.approx(-5.0)
    assert task.reward(np.array([[0.0, 0.0, 1.5 * np.pi]])) == pytest.approx(-np.pi / 4)
    assert task.reward(np.zeros((7, 1, 3))).shape == (7,)


def test_pieces_are_held_one_after_another():
    task = apartment()
    turns, away = Turns(task), np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    held = [turns.held(task.goals + away) for _ in range(3 * TURN)]
    assert held == [0] * TURN + [1] * TURN + [2] * TURN
    turns = Turns(task)
    assert turns.held(task.goals + away * [[0], [1], [1]]) == 1  # the first is where it should be
    assert turns.held(task.goals + away * 0.9 * DONE) == 1  # all are: nothing changes
    assert turns.held(task.goals + away * [[1], [0], [0]]) == 0


def test_a_wrench_acts_on_the_piece_that_is_held_at_its_handle():
    task = apartment()
    strength, handle = jnp.asarray(task.strength), jnp.array([[0.0, 0], [-0.5, 0.2], [0.0, 0]])
    inner = scene_model(task, [piece_model(task, body) for body in range(3)])
    handled = Handled(inner=inner, held=jnp.asarray(1), strength=strength, handle=handle)
    pose = jnp.asarray(task.goals, jnp.float32).at[1, 2].set(0.6)
    action = jnp.array([0.3, -0.5, 0.0])
    wrench = handled.wrench(pose, action)
    cosine, sine = np.cos(0.6), np.sin(0.6)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    force = jnp.asarray(turn @ (np.array([0.3, -0.5]) * 140), jnp.float32)
    x, y = turn @ np.asarray(handle[1])
    expected = [*force, x * force[1] - y * force[0]]
    np.testing.assert_allclose(wrench, [np.zeros(3), expected, np.zeros(3)], atol=1e-3)
    twist = handled.wrench(pose, jnp.array([0.0, 0, 1.0]))
    np.testing.assert_allclose(twist[1], [0, 0, task.strength[1, 2]], atol=1e-4)
    many = handled.wrench(jnp.stack([pose, pose]), jnp.stack([action, action]))
    np.testing.assert_allclose(many[1], wrench, atol=1e-4)


def test_whatever_its_hidden_constants_the_force_on_a_table_drags_its_locked_caster():
    """A push along the table at its middle that is held straight."""
    task = apartment()
    force, _, torque = task.strength[0]
    for seed in range(200):
        hidden = draw_parameters(KINDS["table"], np.random.default_rng(seed))
        mounts = np.array([mount.place for mount in KINDS["table"].mounts])
        locked = next(i for i, angle in enumerate(hidden.locked) if angle is not None)
        centre = KINDS["table"].load_fraction * np.array(hidden.load_place)
        share = np.prod(1 + centre * mounts[locked] / mounts[locked] ** 2) / 4
        drag = hidden.friction * hidden.mass * 9.81 * share
        assert (drag / force) ** 2 + (drag * abs(mounts[locked, 1]) / torque) ** 2 < 1


def test_the_scene_has_the_parameters_of_its_pieces_and_the_contacts_of_the_one_held():
    task = apartment()
    pieces = [
        dataclasses.replace(piece_model(task, body), mass=jnp.array([10.0 + body]))
        for body in range(3)
    ]
    scene = scene_model(task, pieces)
    np.testing.assert_allclose(scene.mass, [10, 11, 12])
    for held in range(3):
        pairs = np.asarray(around(scene, held).pairs)
        assert len(pairs) == 2 + 4  # the other two, and four walls
        assert (pairs[:, [0, 2]] == held).any(axis=1).all()


def decision(moved: bool, touched: bool, number: int) -> Decision:
    state = PlanarState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    poses = np.full((FRAMES, 1, 3), float(number))
    flags = np.array([moved]), np.array([touched])
    return Decision(poses, poses, state, state, np.zeros((1, 3)), 0, *flags)


def test_handling_is_cut_where_the_piece_touches_or_rests():
    kinds = [(True, False), (True, False), (True, True), (False, False), (True, False)]
    episode = Episode(np.full((1, 3), -1.0))
    for number, (moved, touched) in enumerate(kinds):
        episode.decisions.append(decision(moved, touched, number))
    (first, at_rest), (second, later) = episode.handling(0)
    assert (at_rest, later) == (True, False)
    assert first.observation.shape == (1, 2 * FRAMES + 1, 1, 3)
    assert first.observation[0, :2, 0, 0].tolist() == [-1, 0]
    assert second.observation.shape == (1, FRAMES + 1, 1, 3)
    assert second.observation[0, :2, 0, 0].tolist() == [3, 4]
    assert first.action.shape == (1, 2 * FRAMES, 1, 3)


def test_learning_becomes_seldom():
    assert sum(map(due, range(1, 1001))) < 60
    assert all(map(due, range(1, 11)))


def test_the_pieces_in_which_most_happened_are_compared(monkeypatch):
    """Fewer than there is room for are padded by pieces in which nothing is seen."""
    way = jnp.array([0.0, 0.3, 0.1, 0.2])
    target = way[:, None, None, None] * jnp.ones((4, 5, 1, 3))
    zero = jnp.zeros((4, 1, 3))
    pieces = Segments(zero, zero, zero, zero, target, target, jnp.ones(target.shape, bool))
    monkeypatch.setattr(cart_posterior, "MOST", 3)
    picked = cart_posterior.most_informative([pieces.take([0, 1]), pieces.take([2, 3])])
    np.testing.assert_allclose(picked.target[:, 0, 0, 0], [0.3, 0.2, 0.1])
    monkeypatch.setattr(cart_posterior, "MOST", 6)
    picked = cart_posterior.most_informative([pieces])
    assert picked.count == 6
    assert np.asarray(picked.seen).all(axis=(1, 2, 3)).tolist() == [True] * 4 + [False] * 2


def run(task, controller, seed, count):
    return np.concatenate(list(rewards_by_episode(task, controller, seed, count)))


def test_a_trial_is_its_seed_and_begins_anew_after_an_episode():
    task = dataclasses.replace(shopping_cart(), episode=4)
    controller = CartController(task, SMALL, 3)
    first = run(task, controller, 3, 6)
    again = run(task, CartController(task, SMALL, 3), 3, 6)
    other = run(task, CartController(task, SMALL, 4), 4, 6)
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()
    assert [len(episode.decisions) for episode in controller.episodes] == [4, 2]
    idle = CartController(task, SMALL, 3, idle=True)
    still = run(task, idle, 3, 6)
    np.testing.assert_allclose(still[:4], task.reward(idle.episodes[0].first), atol=0.02)
    np.testing.assert_allclose(np.diff(still[:4]), 0, atol=1e-4)


def test_a_regression_is_asked_once_its_piece_was_held():
    task = dataclasses.replace(apartment(), episode=4)
    agent = RegressionController(task, SMALL, 3, "oo-lwr", 16)
    assert agent.believed(0) is None
    run(task, agent, 3, 4)
    assert agent.believed(1) is None
    model = agent.believed(0)
    assert model is not None
    last = agent.episodes[-1].decisions[-1]
    predicted = eqx.filter_jit(model.step)(last.before, jnp.asarray(last.wrench))
    assert np.abs(predicted.pose - last.after.pose).max() < 0.2


def pushed_chair(task, x: float, way: float, force: float) -> Decision:
    """A decision in which the chair stands at x, is pushed along the room and goes that way."""
    before = np.array(task.goals)
    before[2] = x, -1.0, 0.0
    after = before + np.array([[0], [0], [way]]) * [1, 0, 0]
    wrench = np.zeros((3, 3))
    wrench[2, 0] = force
    still = jnp.zeros((3, 3))
    old, new = (PlanarState(jnp.asarray(p, jnp.float32), still) for p in (before, after))
    poses, wrenches = np.stack([after] * FRAMES), np.stack([wrench] * FRAMES)
    moved, touched = np.array([False, False, True]), np.zeros(3, bool)
    return Decision(poses, wrenches, old, new, wrench, 2, moved, touched)


def test_of_two_regressions_only_the_one_of_contact_conditions_knows_what_a_wall_stops():
    """The same push moves a chair that stands free and none at the wall, 10 mm away."""
    task = apartment()
    at_wall = task.room[0] / 2 - 0.32 - 0.01
    forces = np.linspace(10.0, 20.0, 6)
    free = [pushed_chair(task, 0.5, 0.1, force) for force in forces]
    stopped = [pushed_chair(task, at_wall, 0.0, force) for force in forces]

    def ways(kind: str, seen: list[Decision]) -> list[float]:
        agent = RegressionController(task, SMALL, 0, kind, 16)
        agent.episodes.append(Episode(task.goals))
        for one in seen:
            agent.episodes[-1].decisions.append(one)
            agent.learn()
        model = agent.believed(2)
        assert model is not None
        asked = pushed_chair(task, 0.5, 0.0, 15.0), pushed_chair(task, at_wall, 0.0, 15.0)
        after = [model.step(one.before, jnp.asarray(one.wrench, jnp.float32)) for one in asked]
        return [
            float((a.pose - one.before.pose)[2, 0]) for a, one in zip(after, asked, strict=True)
        ]

    np.testing.assert_allclose(ways("oo-lwr", free[:5] + stopped[:5]), [0.1, 0.0], atol=5e-3)
    np.testing.assert_allclose(ways("lwr", free[:5] + stopped[:5]), [0.05, 0.05], atol=0.02)
    assert ways("oo-lwr", free) == ways("lwr", free)  # of a contact never seen nothing is known


def test_a_planner_is_asked_for_what_is_believed(monkeypatch):
    """With a model the action comes from the planner, kept from one decision to the next."""
    asked = []

    def call(self, plan, state, goals):
        asked.append((self.model.inner, int(self.model.held), goals.shape))
        return plan, jnp.array([0.5, 0.0, 0.0])

    monkeypatch.setattr(SamplingPlanner, "__call__", call)
    task = dataclasses.replace(shopping_cart(), episode=2)
    scene = scene_model(task, [piece_model(task, 0)])
    controller = CartController(task, SMALL, 3, scene=scene)
    run(task, controller, 3, 2)
    assert [held for _, held, _ in asked] == [0, 0]
    assert asked[0][2] == (2, 1, 3)
    assert isinstance(asked[0][0], Planar)
    wrench = controller.episodes[0].decisions[0].wrench[0]
    assert np.hypot(*wrench[:2]) == pytest.approx(0.5 * KINDS["cart"].hand_force, rel=1e-4)


def test_physics_learns_after_each_decision_and_keeps_what_is_over(monkeypatch):
    updates, kept, searched = [], [], []

    class Posterior:
        def __init__(self, model, seed, first):
            self.model, self.mass = model, 10.0

        def keep(self, stretches):
            kept.append(len(stretches))

        def update(self, stretches):
            updates.append(sum(a.action.shape[1] for a, _ in stretches))
            self.mass += 1
            return dataclasses.replace(self.model, mass=jnp.array([self.mass]))

        def search(self):
            searched.append(len(kept))

    monkeypatch.setattr(cart_controllers, "PiecePosterior", Posterior)
    monkeypatch.setattr(
        SamplingPlanner, "__call__", lambda self, plan, *_: (plan, jnp.array([0.2, 0.0, 0.0]))
    )
    task = dataclasses.replace(shopping_cart(), episode=3)
    agent = PhysicsController(task, SMALL, 0)
    run(task, agent, 3, 4)
    assert updates == [FRAMES, 2 * FRAMES, 3 * FRAMES, FRAMES]
    assert kept == [1]
    believed = agent.believed(0)
    assert isinstance(believed, Planar)
    assert float(believed.mass[0]) == 14.0
    assert searched == [1]

    searched.clear()
    kept.clear()
    task = dataclasses.replace(task, episode=1)
    run(task, PhysicsController(task, SMALL, 0), 3, 9)
    assert searched == [1, 2, 4, 8]  # after so many episodes


def four_decisions():
    """A cart's posterior that nothing was told yet, and handling to tell it."""
    task = dataclasses.replace(shopping_cart(), episode=4)
    controller = CartController(task, SMALL, 3)
    run(task, controller, 3, 4)
    return PiecePosterior(piece_model(task, 0), 0), controller.episodes[0].handling(0)


def test_climbs_begin_at_the_last_modes_and_beside_the_best(monkeypatch):
    """Beside the best: some of its coordinates drawn anew, the others as they are."""
    begun = []

    def climb(target, start, steps):
        begun.append(np.asarray(start))
        return SimpleNamespace(position=start)

    monkeypatch.setattr(cart_posterior, "climb", climb)
    posterior, handling = four_decisions()
    assert posterior.update([]) is None
    for _ in range(2):
        posterior.update(handling)
    first, second = begun
    assert not first[0].any()
    np.testing.assert_array_equal(second[:2], first[:2])
    kept = second[2:] == first[0]
    assert 0.4 < kept.mean() < 1.0


def test_a_search_compares_what_it_found_with_what_was_known(monkeypatch):
    """Two of what a search of the whole prior finds, and the two modes known so far."""
    begun = []

    def climb(target, start, steps=40):
        begun.append(np.asarray(start))
        return SimpleNamespace(position=start[::-1])

    def settle(target, key):
        return target, SimpleNamespace(position=jnp.full((6, target.dimension), 7.0))

    monkeypatch.setattr(cart_posterior, "climb", climb)
    monkeypatch.setattr(cart_posterior, "settle", settle)
    posterior, handling = four_decisions()
    assert posterior.search() is None
    posterior.keep(handling)
    posterior.search()
    known = begun[0][2:]
    assert known.shape == (1, begun[0].shape[1])
    np.testing.assert_array_equal(begun[0][:2], 7.0)
    np.testing.assert_allclose(known[0, :-6], 0.0, atol=1e-6)  # the prior's centre, of parameters
    posterior.search()
    np.testing.assert_array_equal(begun[1][2:], begun[0][::-1][:2])  # the best of the last climb


def test_who_is_told_a_model_climbs_from_it_first(monkeypatch):
    """From the hidden constants themselves, as a planar model has them."""
    begun, task = [], dataclasses.replace(apartment(), episode=1)

    def climb(target, start, steps):
        begun.append(target.model(start[0]))
        return SimpleNamespace(position=start)

    monkeypatch.setattr(cart_posterior, "climb", climb)
    controller, world = CartController(task, SMALL, 3), task.world()
    run(task, controller, 3, 1)
    world.reset(3)
    told, truth = cart_trials._hidden(task, 3), world.truth()
    PiecePosterior(piece_model(task, 0), 0, told[0]).update(controller.episodes[0].handling(0))
    hidden = truth.parameters[0]
    locked = next(i for i, angle in enumerate(hidden.locked) if angle is not None)
    place = begun[0].wheel_position[0, 0] * begun[0].half_extent[0]
    np.testing.assert_allclose(begun[0].mass, hidden.mass, rtol=1e-4)
    np.testing.assert_allclose(place, truth.wheel_places[0][locked], atol=1e-4)
    np.testing.assert_allclose(told[1].floor_friction, truth.parameters[1].friction, rtol=1e-5)
    np.testing.assert_allclose(told[1].wheel_along, piece_model(task, 1).wheel_along)


def test_the_best_scene_is_learnt_from_handling_and_from_other_starts(monkeypatch):
    seen, task = [], dataclasses.replace(shopping_cart(), episode=2)
    scene = scene_model(task, [piece_model(task, 0)])

    class Learner(CartController):
        def __init__(self, task, planning, seed, first_episode, handled, begun):
            super().__init__(task, planning, seed, first_episode)
            assert len(begun) == len(handled)
            seen.append([len(stretches) for stretches in handled])

        def search(self):
            seen.append("searched")
            return scene

        def learn(self):
            seen.append(self.episodes[-1].first)

    monkeypatch.setattr(cart_trials, "PhysicsController", Learner)
    monkeypatch.setattr(cart_trials, "HANDLED", 0.2)
    monkeypatch.setattr(cart_trials, "PRACTISED", 1)
    assert best_scene(task, SMALL, 3) is scene
    assert seen[:2] == [[3 + cart_trials.TOSSED], "searched"]  # wiggled, and pushed anyhow
    assert seen[4:] == ["searched"]
    controller = CartController(task, SMALL, 3)
    run(task, controller, 3, 1)
    assert np.abs(controller.episodes[0].first - seen[2]).max() > 0.1


def earned(worlds: int, decisions: int) -> cart_online.Rewards:
    means = dict.fromkeys(cart_online.AGENTS, -2.0) | {"TRUE": -1.0, "PBRL": -1.02, "random": -3.0}
    random = np.random.default_rng(0)
    return {
        agent: mean + 0.01 * random.normal(size=(worlds, decisions))
        for agent, mean in means.items()
    }


def test_regret_is_a_share_of_what_there_is_to_learn():
    rewards = earned(5, 200)
    figures = {figure.name: figure for figure in cart_online.figures("cart", rewards)}
    assert figures["cart.regret"].value == pytest.approx(0.01, abs=2e-3)
    assert figures["cart.regret"].met is True
    assert figures["cart.regret"].rival == pytest.approx(0.5, abs=0.01)
    rewards["PBRL"][3] -= 0.2  # in one world; and in another TRUE falls short
    rewards["TRUE"][1] -= 0.6
    worst = {one.name: one.value for one in cart_online.figures("cart", rewards)}
    assert worst["cart.regret"] < 0.05
    assert worst["cart.regret_worst_world"] == pytest.approx(0.22 / 1.88, abs=5e-3)
    rewards = earned(5, 200)
    assert figures["cart.regret.doing_nothing"].value == pytest.approx(0.5, abs=0.01)
    assert cart_online.regret(rewards, "random", slice(None)).mean() == pytest.approx(1.0)
    assert cart_online.regret(rewards, "TRUE", slice(None)).tolist() == [0.0] * 5
    assert figures["cart.regret"].spread > 0.0
    assert cart_online.figures("cart", earned(1, 200))[0].spread is None


def test_what_was_earned_is_kept_and_only_what_was_cut_off_begins_anew(tmp_path, monkeypatch):
    worked = []

    def rewards(task, controller, seed, decisions):
        worked.append((task.name, seed, controller))
        for done in range(0, decisions, task.episode):
            if len(worked) == 3:
                raise KeyboardInterrupt
            yield -1.0 / np.arange(done + 1, done + task.episode + 1) - 0.1 * len(worked)

    monkeypatch.setattr(cart_online, "rewards_by_episode", rewards)
    monkeypatch.setattr(cart_online, "_controller", lambda task, who, *_: who)
    with pytest.raises(KeyboardInterrupt):
        cart_online.reproduce(tmp_path, quick=True)
    assert len(worked) == 3
    result = cart_online.reproduce(tmp_path, quick=True)
    assert len(worked) == 3 + 2 * len(cart_online.AGENTS) - 2
    assert sum(who == cart_online.NOTHING for *_, who in worked) == 2
    assert {seed for _, seed, _ in worked} == {cart_online.EVALUATION_SEEDS}
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    names = [figure.name for figure in result.figures]
    assert {"cart.regret", "apartment.regret"} <= set(names)
    count = len(worked)
    assert (
        cart_online.reproduce(tmp_path, quick=True).to_dict()["figures"]
        == (result.to_dict()["figures"])
    )
    assert len(worked) == count
