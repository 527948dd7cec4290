"""Episodes of the Shopping-Cart and Apartment tasks in MuJoCo, and the controller that is told."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.planar import Planar
from palpate.parameters import with_values
from palpate.recordings import Aligned
from palpate.runs import Figure
from palpate.tasks.furniture.cart import CartTask
from palpate.trials.furniture.cart_controllers import (
    FRAMES,
    CartController,
    PhysicsController,
    Planning,
    piece_model,
)
from palpate.trials.trial import Record, Trial, run_trials
from palpate.worlds.furniture.furniture import (
    CONTROL_PERIOD,
    FurnitureObservation,
    FurnitureTruth,
    FurnitureWorld,
    Piece,
)
from palpate.worlds.furniture.handling import record_handling
from palpate.worlds.furniture.scene import GRAVITY

HANDLED, TOSSED, PRACTISED = 15.0, 2, 4  # s, three times; and episodes: of TRUE
HANDLING, PRACTICE, TOSSING = 10_000, 20_000, 30_000  # episodes' numbers, unlike those that count


@dataclasses.dataclass(frozen=True)
class Rewards(Record):
    """What was earned in episodes; see `Record`.

    `reward` (trials, times) of a decision that would end then, of where the pieces truly are;
    `poses` (drawn trials, times, bodies, 3) m, m, rad, as seen.
    """

    observed: ClassVar[str] = "poses"
    reward: np.ndarray
    poses: np.ndarray
    failures: dict[int, str]


@dataclasses.dataclass(frozen=True)
class CartTrial(Trial[Rewards]):
    """One episode in the world of a seed, from pieces at rest at `start` (bodies, 3) on."""

    task: CartTask
    seed: int
    episode: int  # with the seed draws casters and noise
    start: np.ndarray
    steps: int

    @property
    def control_period(self) -> float:
        return CONTROL_PERIOD

    @property
    def group(self) -> str:
        """See `Trial`: the task."""
        return self.task.name

    @property
    def reset_options(self) -> Mapping[str, Any]:
        return {"episode": self.episode, "poses": self.start}

    @property
    def command(self) -> np.ndarray:
        """See `Trial`: nobody holds anything."""
        return np.zeros((len(self.task.kinds), 3))

    def world(self) -> FurnitureWorld:
        return self.task.world()

    def measure(
        self, observation: FurnitureObservation, truth: FurnitureTruth
    ) -> Mapping[str, Any]:
        return {"reward": self.task.reward(truth.poses)}

    @classmethod
    def record(cls, trials: Sequence["CartTrial"], steps: int, drawn: int) -> Rewards:
        shape = steps + 1, len(trials[0].task.kinds), 3
        reward = np.full((len(trials), steps + 1), np.nan)
        return Rewards(reward, np.full((drawn, *shape), np.nan), {})

    @classmethod
    def figures(
        cls, trials: Sequence["CartTrial"], record: Rewards, suffix: str = ""
    ) -> list[Figure]:
        mean = float(np.nanmean(record.reward))
        return [Figure(f"mean_reward{suffix}", mean, "m", better="higher")]


def rewards_by_episode(
    task: CartTask, controller: CartController, seed: int, decisions: int, first_episode: int = 0
) -> Iterator[np.ndarray]:
    """The reward of each decision, episode by episode, in the world of a seed.

    Raises `PalpateError` when the simulation diverges.
    """
    starts = np.random.default_rng([seed, 8, first_episode])
    for done in range(0, decisions, task.episode):
        episode, left = first_episode + done // task.episode, min(task.episode, decisions - done)
        steps = left * FRAMES + 1  # the last shows what became of the last decision
        trial = CartTrial(task, seed, episode, task.start(starts), steps)
        record = run_trials([trial], controller)
        if record.failures:
            raise PalpateError(record.failures[0])
        yield record.reward[0, FRAMES::FRAMES]


def best_scene(task: CartTask, planning: Planning, seed: int) -> Planar:
    """The planar model that explains most of what it meets in this task: what TRUE is told.

    Of the same pieces, of the same hidden parameters: as they stand apart, without walls, and each
    is wiggled for three times `HANDLED`; as anything is done with them for `TOSSED` episodes; and
    as an agent that learnt from this brings them to their places for `PRACTISED` episodes of the
    task, from other starts than those that count. The search begins at the hidden constants: from
    elsewhere it may end at a table that is too heavy to be moved, is believed, and so never seen to
    move. Nor does wiggling tell at what force a caster gives way that holds more than that takes.
    """
    stretches = _wiggle(task, seed)
    tossed = CartController(task, planning, seed, TOSSING)
    list(rewards_by_episode(task, tossed, seed, TOSSED * task.episode, TOSSING))
    for body, handled in enumerate(stretches):
        handled += [one for episode in tossed.episodes for one in episode.handling(body)]
    hidden = _hidden(task, seed)
    practising = PhysicsController(task, planning, seed, PRACTICE, stretches, hidden)
    practising.search()
    list(rewards_by_episode(task, practising, seed, PRACTISED * task.episode, PRACTICE))
    return practising.search()


def _hidden(task: CartTask, seed: int) -> list[Planar]:
    """Each piece with the hidden constants that mean the same in a planar model."""
    world = task.world()
    world.reset(seed)
    truth, pieces = world.truth(), []
    for body, hidden in enumerate(truth.parameters):
        piece = piece_model(task, body)
        extent, centre = np.asarray(piece.half_extent)[0], truth.centres[body]
        feet = all(mount.type == "foot" for mount in truth.kinds[body].mounts)
        gyration = np.sqrt(truth.inertias[body] / hidden.mass) / np.asarray(piece.even_gyration)
        values = {
            "mass": [hidden.mass],
            "centre_of_mass": [centre / extent],
            "gyration": gyration,
            "floor_friction": [hidden.friction if feet else hidden.rolling_resistance],
        }
        for place, angle in zip(truth.wheel_places[body], hidden.locked, strict=True):
            if angle is not None:
                share = np.prod(1 + centre * place / place**2) / 4  # of the weight, on this wheel
                drag = hidden.friction * hidden.mass * GRAVITY * share
                values |= {
                    "wheel_position": [[place / extent]],
                    "wheel_along": [[drag]],
                    "wheel_across": [[drag]],
                }
        placed = {path: jnp.asarray(value, piece.mass.dtype) for path, value in values.items()}
        pieces.append(with_values(piece, placed))
    return pieces


def _wiggle(task: CartTask, seed: int) -> list[list[tuple[Aligned, bool]]]:
    """Handling of each piece, that begins at rest, as `Episode.handling` has it."""
    poses = [(4.0 * index, 0.0, 0.0) for index in range(len(task.kinds))]
    world = FurnitureWorld(
        [Piece(kind, pose) for kind, pose in zip(task.kinds, poses, strict=True)]
    )
    stretches: list[list[tuple[Aligned, bool]]] = [[] for _ in task.kinds]
    for repetition in range(3):
        first = HANDLING + 10 * repetition
        for body, trial in enumerate(record_handling(world, seed, HANDLED, first).trials):
            poses = trial.channels["pose"].values[:, body : body + 1]
            wrenches = trial.channels["wrench"].values[:, body : body + 1]
            aligned = Aligned(CONTROL_PERIOD, poses[None], wrenches[None], np.array([len(poses)]))
            stretches[body].append((aligned, True))
    return stretches
