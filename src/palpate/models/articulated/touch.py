"""A fingertip on a flat face of a link: a spring and a damper that only push, and dry friction.

By the position and velocity at the end of a step, as all that resists in `integration`: stable for
any stiffness, and never a source of energy by itself. Shapes as in `kinematics`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

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

    def speed(self, rates: Each) -> Point:
        """Of the link's point against the tip, m/s."""
        return jnp.sum(self.moves * rates, axis=1) - self.velocity

    def pressing(self, rates: Each, time_step: float) -> Number:
        """N, of the tip on the face, at the end of a step that ends with these velocities."""
        face, deeper = self.face, jnp.sum(self.normal * self.speed(rates), axis=0)
        ahead = self.depth + time_step * deeper
        force = face.stiffness * ahead + face.damping * deeper
        return jnp.where(ahead > 0.0, jnp.maximum(force, 0.0), 0.0)

    def rubbing(self, rates: Each, force: Number, slip: float) -> Number:
        """Dry friction over sliding velocity, N s/m: half of it is there at `slip` m/s."""
        sliding = self.speed(rates)
        sliding = sliding - self.normal * jnp.sum(self.normal * sliding, axis=0)
        size = jnp.sqrt(jnp.sum(jnp.square(sliding), axis=0) + slip**2)
        return self.face.friction * force / size

    def resistance(
        self, rates: Each, time_step: float, slip: float
    ) -> tuple[Float[Array, "links links #lanes"], Each]:
        """What it adds to the joints' damping, as a matrix, and what it exerts at no velocity.

        Whether it presses, and how much friction there is, are those of a step that ends with
        about these velocities.
        """
        face, force = self.face, self.pressing(rates, time_step)
        presses, rub = force > 0.0, self.rubbing(rates, force, slip)
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
