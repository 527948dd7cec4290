"""Who learns the Shopping-Cart and Apartment tasks online, and by what.

Each agent believes in some model of the scene whose step is a decision; the same planner plans
through all of them (`cart_online`). Physics-based agents have a planar model of each piece, whose
posterior (`cart_posterior`) is climbed anew as data arrive, and after 1, 2, 4, ... episodes
searched all over, as that of a recording is: a climb may stay where a table is heavy that in truth
is held by its caster. Regressions have the transitions of decisions.
"""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from palpate.identification.regression.locally_weighted import LocallyWeighted, locally_weighted
from palpate.identification.regression.model import Features, RegressedModel
from palpate.models.model import Model, Wrapper
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.parameters import Parameter, declare, parameters_of, value_of, with_values
from palpate.recordings import Aligned
from palpate.tasks.furniture.cart import DECISION, CartTask
from palpate.trials.furniture.cart_posterior import PiecePosterior
from palpate.trials.furniture.planar_features import body_features
from palpate.worlds.furniture.furniture import CONTROL_PERIOD

FRAMES = round(DECISION / CONTROL_PERIOD)  # observed in a decision
SUBSTEPS = 2  # of a decision, in planning


class Handled(Wrapper):
    """A scene in which one piece is held: an action is a share (along, across, turn) of its wrench.

    Forces act at the piece's handle, in its axes as it stands when the decision is taken, and keep
    their directions in the room until the next.
    """

    inner: Model  # its action is a wrench on each body, its step a decision
    held: Int[Array, ""]
    strength: Float[Array, "bodies 3"]
    handle: Float[Array, "bodies 2"]
    control_period: float = eqx.field(static=True, default=DECISION)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int]:
        """(3,): along, across, turn."""
        return (3,)

    def wrench(self, pose: Array, action: Array) -> Float[Array, "*batch bodies 3"]:
        """What acts on each body, in the room's axes about the bodies' origins."""
        local = action * self.strength[self.held]
        lever = self.handle[self.held]
        angle = jnp.take(pose[..., 2], self.held, axis=-1)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        along, across = local[..., 0], local[..., 1]
        torque = local[..., 2] + lever[0] * across - lever[1] * along
        x, y = cosine * along - sine * across, sine * along + cosine * across
        one = jnp.stack([x, y, torque], axis=-1)
        return one[..., None, :] * jax.nn.one_hot(self.held, pose.shape[-2])[:, None]

    def step(self, state: PlanarState, action: Array) -> PlanarState:
        """See `Model.step`."""
        return self.inner.step(state, self.wrench(state.pose, action))


@dataclasses.dataclass(frozen=True)
class Decision:
    """What was done in one decision and what was seen of it.

    `poses` and `wrenches` (periods, bodies, 3) as measured at the end of, and over, each control
    period; `before` and `after` the states as estimated; `wrench` (bodies, 3) as commanded. A piece
    that `moved` (bodies,) was held or moved visibly; one that `touched` had another or a wall near.
    """

    poses: np.ndarray
    wrenches: np.ndarray
    before: PlanarState
    after: PlanarState
    wrench: np.ndarray
    held: int
    moved: np.ndarray
    touched: np.ndarray


@dataclasses.dataclass(frozen=True)
class Episode:
    """The poses (bodies, 3) seen at its start, at rest, and its decisions so far."""

    first: np.ndarray
    decisions: list[Decision] = dataclasses.field(default_factory=list)

    def handling(self, body: int) -> list[tuple[Aligned, bool]]:
        """Stretches in which one piece moved and touched nothing, and whether each began at rest.

        As recordings of that piece alone.
        """
        told = [d.moved[body] and not d.touched[body] for d in self.decisions]
        stretches, index = [], 0
        while index < len(told):
            if not told[index]:
                index += 1
                continue
            end = next((i for i in range(index, len(told)) if not told[i]), len(told))
            run = self.decisions[index:end]
            start = self.first if index == 0 else self.decisions[index - 1].poses[-1]
            poses = np.concatenate([start[None], *(d.poses for d in run)])[:, body : body + 1]
            wrenches = np.concatenate([d.wrenches for d in run])[:, body : body + 1]
            length = np.array([len(poses)])
            stretches.append(
                (Aligned(CONTROL_PERIOD, poses[None], wrenches[None], length), index == 0)
            )
            index = end
        return stretches


@runtime_checkable
class Agent(Protocol):
    """Learns after each decision; `believed` is None as long as it has nothing to plan with."""

    def learn(self, episodes: list[Episode]) -> None:
        """Take account of the newest decision of the last episode."""
        ...

    def believed(self, held: int) -> Model | None:
        """The scene whose step is a decision, to plan for the piece that is held."""
        ...


class Knowing:
    """Told a model beforehand, or nothing at all: never learns."""

    def __init__(self, scene: Planar | None):
        self._scene = scene

    def learn(self, episodes: list[Episode]) -> None:
        """See `Agent.learn`."""

    def believed(self, held: int) -> Model | None:
        """See `Agent.believed`."""
        return None if self._scene is None else around(self._scene, held)


def piece_model(task: CartTask, body: int) -> Planar:
    """A piece alone, its parameters at their priors; contacts are not identified."""
    alone = furniture([task.outlines[body]], wheels=1, control_period=CONTROL_PERIOD)
    return declare(alone, restitution={"fixed": True}, contact_friction={"fixed": True})


def around(scene: Planar, held: int) -> Planar:
    """The scene with the contacts of the piece that is held alone: the others stand.

    Of as many pairs whichever it is, so that nothing is compiled anew.
    """
    pairs = np.asarray(scene.pairs)
    return dataclasses.replace(scene, pairs=pairs[(pairs[:, [0, 2]] == held).any(axis=1)])


def scene_model(task: CartTask, pieces: list[Planar]) -> Planar:
    """All pieces in the room, each with the parameters it was found to have alone.

    Its step is a decision.
    """
    scene = furniture(
        task.outlines, task.walls, wheels=1, control_period=DECISION, substeps=SUBSTEPS
    )
    values = {
        path: jnp.concatenate([value_of(piece, path) for piece in pieces])
        for path in parameters_of(scene)
        if value_of(scene, path).size
    }
    return with_values(scene, values)


class PhysicsAgent:
    """Physics-based RL: plans through the most probable planar model of every piece so far.

    `handled` is what it saw of each piece before, if anything, and `told` where to look first.
    """

    def __init__(
        self,
        task: CartTask,
        seed: int,
        handled: Sequence[list[tuple[Aligned, bool]]] = (),
        told: Sequence[Planar] = (),
    ):
        self._task = task
        self._pieces = [
            PiecePosterior(piece_model(task, body), 100 * seed + body, told[body] if told else None)
            for body in range(len(task.kinds))
        ]
        self._models = [piece.model for piece in self._pieces]
        for piece, stretches in zip(self._pieces, handled, strict=False):
            piece.keep(stretches)
        self._scene = scene_model(task, self._models)
        self._learnt = [0] * len(self._pieces)  # decisions in which each was held

    def search(self) -> Planar:
        """Look for the modes of all pieces anew; the scene as they have it then."""
        for body, piece in enumerate(self._pieces):
            self._models[body] = piece.search() or self._models[body]
        self._scene = scene_model(self._task, self._models)
        return self._scene

    def learn(self, episodes: list[Episode]) -> None:
        """See `Agent.learn`."""
        episode = episodes[-1]
        held = episode.decisions[-1].held
        self._learnt[held] += 1
        if due(self._learnt[held]):
            found = self._pieces[held].update(episode.handling(held))
            if found is not None:
                self._models[held] = found
                self._scene = scene_model(self._task, self._models)
        if len(episode.decisions) == self._task.episode:
            for body, piece in enumerate(self._pieces):
                piece.keep(episode.handling(body))
            if len(episodes).bit_count() == 1:
                self.search()

    def believed(self, held: int) -> Model | None:
        """See `Agent.believed`."""
        return around(self._scene, held)


class RegressionAgent:
    """Plans through a regression of each piece's decisions; knows no piece before it was held.

    `kind` is as in `identification.regression_model`.
    """

    def __init__(self, task: CartTask, kind: str, decisions: int):
        self._prototype = scene_model(task, [piece_model(task, b) for b in range(len(task.kinds))])
        features = body_features(task.outlines, task.walls)
        condition = features.condition if kind == "oo-lwr" else None
        self._features = dataclasses.replace(features, condition=condition)
        self._data: list[list[tuple[np.ndarray, ...]]] = [[] for _ in task.kinds]
        self._parts: list[LocallyWeighted | None] = [None] * len(task.kinds)
        self._capacity = decisions

    def learn(self, episodes: list[Episode]) -> None:
        """See `Agent.learn`."""
        one = episodes[-1].decisions[-1]
        inputs, change, condition = map(
            np.asarray, _datum(self._features, one.before, jnp.asarray(one.wrench), one.after)
        )
        for body in np.flatnonzero(one.moved):
            self._data[body].append((inputs[body], change[body], condition[body]))
            if due(len(self._data[body])) or self._parts[body] is None:
                columns = [np.stack(column) for column in zip(*self._data[body], strict=True)]
                self._parts[body] = locally_weighted(*columns, capacity=self._capacity)

    def believed(self, held: int) -> Model | None:
        """See `Agent.believed`."""
        if self._parts[held] is None:
            return None
        # What was never held is believed to behave as this one: something has to be believed.
        parts = [part if part is not None else self._parts[held] for part in self._parts]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        return RegressedModel(
            inner=self._prototype,
            regression=stacked,
            features=self._features,
            control_period=DECISION,
        )


def due(count: int) -> bool:
    """Whether an agent learns anew after that many decisions: the seldomer the more it knows."""
    return count <= 10 or (count <= 50 and count % 5 == 0) or count % 50 == 0


@eqx.filter_jit
def _datum(features: Features, before: PlanarState, wrench: Array, after: PlanarState):
    inputs = features.inputs(before, wrench)
    condition = jnp.zeros((len(inputs), 0), bool)
    if features.condition is not None:
        condition = features.condition(before)
    return inputs, features.change(before, after), condition
