"""Plans carried out in the MuJoCo world, by a planner that is told the truth."""

import numpy as np
import pytest

from palpate.planning.movable_obstacles.motion.constrained import ConstrainedManipulation, Drawn
from palpate.planning.movable_obstacles.motion.primitives import Constraint
from palpate.planning.movable_obstacles.search.plan import TRANSIT, Plan, Segment
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.trials.furniture import namo_episode, namo_execution
from palpate.trials.furniture import rooms as namo_rooms
from palpate.trials.furniture.namo_episode import Flag, Opinion, episode
from palpate.trials.furniture.namo_execution import Contact, Execution, OutOfTimeError
from palpate.trials.furniture.rooms import scenes

BUDGET = 60.0
ROOM = scenes()["static constraint"]


def plan_with(static: str) -> tuple[Execution, Plan, list[Contact]]:
    contacts: list[Contact] = []
    run = Execution(ROOM, contacts.append, BUDGET)
    held = {"cabinet": Drawn((Constraint("free"),)), "cabinet 2": Drawn((Constraint("free"),))}
    held[static] = Drawn((Constraint("static"),))
    model = ConstrainedManipulation(held, 60.0)
    world = ROOM.map(run.outlines, run.poses(), run.robot())
    return run, Planner(model).plan(world), contacts


def test_a_free_piece_is_brought_where_the_plan_has_it():
    run, plan, contacts = plan_with(static="cabinet")
    transfer = plan.segments[1]
    assert transfer.name == "cabinet 2"
    assert transfer.object_poses is not None
    assert run.drive(plan.segments[0], True)
    assert run.transfer(transfer, False) > 0.95
    off = run.poses()[1] - transfer.object_poses[-1]
    assert np.hypot(*off[:2]) < 0.05
    assert abs(off[2]) < 0.1
    (contact,) = contacts
    assert contact.name == "cabinet 2"
    assert len(contact.poses) == len(contact.wrenches) == len(contact.alone)
    assert np.abs(contact.wrenches).max() > 1.0
    assert 0 < run.carried < run.distance
    assert run.time < BUDGET


def test_a_bolted_piece_is_noticed_and_its_force_is_felt():
    run, plan, contacts = plan_with(static="cabinet 2")
    before = run.poses()[0]
    assert run.drive(plan.segments[0], True)
    begun = run.time
    assert run.transfer(plan.segments[1], False) < 0.1
    assert run.time - begun < 8.0  # s: it does not pull for ever
    assert np.abs(run.poses()[0] - before).max() < 0.01
    force = np.linalg.norm(np.array(contacts[0].wrenches)[:, :2], axis=1)
    pulled = force[: round(namo_execution.STUCK_AFTER / run.period)]
    assert 0.5 * namo_execution.FORCE < np.median(pulled) < 2 * namo_execution.FORCE


def test_bumping_into_something_is_a_contact_as_well():
    contacts: list[Contact] = []
    run = Execution(ROOM, contacts.append, BUDGET)
    x, y, _ = run.robot()
    through = np.array([[x, y, 0.0], [x + 3.5, y, 0.0]])
    assert not run.drive(Segment(TRANSIT, through, 3.5), False)
    run.back_off(0.35)
    assert [contact.name for contact in contacts] == ["cabinet"]
    assert np.abs(np.array(contacts[0].wrenches)[:, 0]).max() > 20.0  # N
    assert contacts[0].alone[0]
    gap = run.poses()[0, 0] - 0.25 - run.robot()[0]
    assert gap > 0.33


def test_time_runs_out():
    run = Execution(ROOM, lambda contact: None, BUDGET)
    run.budget = run.time
    with pytest.raises(OutOfTimeError):
        run.back_off(2.0)
    assert run.time == run.budget


def test_told_the_truth_a_locked_piece_is_turned_about_its_caster():
    room = scenes()["learning by contact"]
    outcome = episode(room, Opinion(namo_episode.truth_of(room)))
    assert outcome.reached, outcome.reason
    assert [name for name, _ in outcome.tried] == ["cabinet"]
    assert namo_episode.truth_of(room)["cabinet"].kind == "pivot"


@pytest.mark.parametrize(
    ("seed", "kind"),
    [(2004, "axis"), (2092, "pivot"), (2006, "pivot")],
    ids=["on wheels across the way", "held twice", "close by the wall"],
)
def test_told_the_truth_the_one_piece_that_gives_way_is_got_past(seed, kind):
    room = namo_rooms.generated_room(seed)
    truth = namo_episode.truth_of(room)
    outcome = episode(room, Opinion(truth))
    assert outcome.reached, outcome.reason
    assert outcome.failures == 0
    assert {truth[name].kind for name, _ in outcome.tried} == {kind}


def test_the_flag_weighs_failures_against_what_came_along():
    flag = Flag(("a", "b"))
    assert not flag.immovable()
    flag.tried("a", 0.0)
    flag.tried("b", 1.0)
    assert flag.immovable() == {"a"}
    assert flag.movability()["a"] == pytest.approx(0.7 * 0.1 / (0.7 * 0.1 + 0.3 * 0.9))
    assert flag.movability()["b"] == pytest.approx(0.7 * 0.9 / (0.7 * 0.9 + 0.3 * 0.1))
    flag.tried("b", 0.2)  # the one undoes the other
    assert flag.movability()["b"] == pytest.approx(0.7)
    flag.tried("b", 0.2)
    assert flag.immovable() == {"a", "b"}


def test_what_never_learns_tries_the_same_piece_until_its_attempts_are_over(monkeypatch):
    monkeypatch.setattr(namo_episode, "ATTEMPTS", 2)
    outcome = episode(ROOM, Opinion(dict.fromkeys(("cabinet", "cabinet 2"), Constraint("free"))))
    assert not outcome.reached
    assert outcome.reason == "attempts"
    assert [name for name, _ in outcome.tried] == ["cabinet", "cabinet"]
    assert outcome.failures == 2
