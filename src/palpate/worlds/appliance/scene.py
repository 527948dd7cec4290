"""What an appliance's world is made of: a MuJoCo model, and what moves in it."""

import dataclasses
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int


class MovingPart(NamedTuple):
    """A part that moves on its parent, a part before it (-1: on what stands still).

    Resistance is in N m or N, and N m s or N s/m.
    """

    name: str
    parent: int
    joint: Literal["revolute", "prismatic"]
    low: float  # rad or m, the ends of its range
    high: float
    friction: float
    damping: float
    size: float  # m, the longest edge of a box around what is seen of it

    @property
    def range(self) -> float:
        """From one end to the other, rad or m."""
        return self.high - self.low


@dataclasses.dataclass(frozen=True)
class Latches:
    """What pulls parts shut: `force` at zero, and 1/e of it when open by `reach`; 0 of others."""

    force: Float[np.ndarray, " parts"]  # N m or N
    reach: Float[np.ndarray, " parts"]  # rad or m

    def pull(self, position: Float[np.ndarray, " parts"]) -> Float[np.ndarray, " parts"]:
        """What acts at each joint at these positions (rad or m), in N m or N."""
        return -self.force * np.exp(-np.maximum(position, 0.0) / self.reach)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A compiled model, and which of its joints and bodies are the parts that move.

    `middle` (m) and `size` (m, a diagonal) are of what stands still, with all parts closed; cameras
    stand in the direction `front` (rad about z, from x), or around it, and `above` it or level.
    """

    name: str
    model: mujoco.MjModel
    parts: tuple[MovingPart, ...]
    joints: Int[np.ndarray, " parts"]  # of the model, that of each part
    latches: Latches
    closed: Float[np.ndarray, " parts"]  # rad or m: from where parts open, to the further end
    middle: Float[np.ndarray, "3"]
    size: float
    front: float
    above: bool

    @property
    def bodies(self) -> Int[np.ndarray, " parts"]:
        """The body of each part."""
        return self.model.jnt_bodyid[self.joints]

    @property
    def addresses(self) -> Int[np.ndarray, " parts"]:
        """Where each part's position is in MuJoCo's `qpos`."""
        return self.model.jnt_qposadr[self.joints]

    @property
    def freedoms(self) -> Int[np.ndarray, " parts"]:
        """Where each part's velocity is in MuJoCo's `qvel`."""
        return self.model.jnt_dofadr[self.joints]

    @property
    def travel(self) -> Float[np.ndarray, " parts"]:
        """From closed to the further end, rad or m, with its sign."""
        ends = np.array([(part.low, part.high) for part in self.parts]).reshape(-1, 2)
        ends = ends - self.closed[:, None]
        return ends[np.arange(len(ends)), np.abs(ends).argmax(axis=1)]


def labels_of(
    model: mujoco.MjModel, bodies: Int[np.ndarray, " parts"]
) -> Int[np.ndarray, " bodies"]:
    """The part that each body of a model belongs to, -1 of what stands still.

    `bodies` are those of the parts; what is fixed to one belongs to it.
    """
    numbers = {int(body): number for number, body in enumerate(bodies)}
    found = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        found[body] = numbers.get(body, found[model.body_parentid[body]])
    return found
