"""A fingertip on a flat face of a link: a spring and a damper that only push, and dry friction.

Kelvin's and Voigt's contact with Coulomb's friction, by the position and velocity at the end of a
step, linearised about its beginning (Baraff and Witkin, "Large steps in cloth simulation", SIGGRAPH
1998): stable for any stiffness, and never a source of energy by itself. Shapes as in `kinematics`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from palpate.models.articulated.kinematics import Affine, Among, Each, Joints, apply, fields

Number = Float[Array, "#lanes"]
Point = Float[Array, "3 #lanes"]


class Face(NamedTuple):
    """Where a link is touched, in its frame, and how it yields."""

    link: Float[Array, " links"]  # one for the link, zero for the others
    place: Point  # m, a point of the face
    normal: Point  # outward, of length one
    stiffness: Number  # N/m
    damping: Number  # N s/m
    friction: Number


class Tip(NamedTuple):
    """A fingertip in the world: m and m/s."""

    position: Point
    velocity: Point


class Touch(NamedTuple):
    """A tip against a face at one position of the tree.

    The point of the link that the tip touches moves with `moves` (3, links) times the joints'
    velocities; the tip is `depth` m within the face, whose outward normal in the world is `normal`.
    """

    face: Face
    moves: Float[Array, "3 links #lanes"]
    normal: Point
    depth: Number
    velocity: Point

    def motion(self, rates: Each) -> tuple[Number, Point]:
        """How fast the tip gets deeper (m/s), and how the link's point slides against it (m/s)."""
        relative = jnp.sum(self.moves * rates, axis=1) - self.velocity
        deeper = jnp.sum(self.normal * relative, axis=0)
        return deeper, relative - self.normal * deeper

    def pressing(self, deeper: Number, time_step: float) -> Number:
        """N, of the tip on the face, at the end of a step in which it gets deeper so (m/s)."""
        ahead = self.depth + time_step * deeper
        force = self.face.stiffness * ahead + self.face.damping * deeper
        return jnp.where(ahead > 0.0, jnp.maximum(force, 0.0), 0.0)

    def resistance(
        self, presses: Bool[Array, "#lanes"], rub: Number, time_step: float
    ) -> tuple[Float[Array, "links links #lanes"], Each]:
        """What it adds to the joints' damping, as a matrix, and what it exerts at no velocity.

        While it presses, with `rub` N s/m of dry friction over the sliding velocity.
        """
        face = self.face
        yields = jnp.where(presses, face.damping + time_step * face.stiffness, 0.0)
        along = jnp.sum(self.normal[:, None] * self.moves, axis=0)
        every = jnp.sum(self.moves[:, :, None] * self.moves[:, None, :], axis=0)
        matrix = (yields - rub) * along[:, None] * along[None, :] + rub * every
        leaving = jnp.sum(self.normal * self.velocity, axis=0)
        held = jnp.where(presses, face.stiffness * self.depth, 0.0)
        dragged = jnp.sum(self.moves * self.velocity[:, None], axis=0)
        return matrix, along * ((yields - rub) * leaving - held) + rub * dragged


def touch_of(face: Face, tip: Tip, joints: Joints, pose: Affine, carried: Among) -> Touch:
    """The touch at a position of the tree, whose links are at `pose`."""
    field = fields(joints, pose)
    moves = apply(field.matrix, jnp.broadcast_to(tip.position, field.vector.shape)) + field.vector
    moves = moves * (face.link @ carried)[:, None, None]
    turn = jnp.sum(pose.matrix * face.link[:, None, None, None], axis=0)
    origin = jnp.sum(pose.vector * face.link[:, None, None], axis=0)
    normal = apply(turn, face.normal)
    place = origin + apply(turn, face.place)
    depth = jnp.sum(normal * (place - tip.position), axis=0)
    return Touch(face, jnp.moveaxis(moves, 0, 1), normal, depth, tip.velocity)
