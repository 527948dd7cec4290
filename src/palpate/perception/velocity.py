"""Velocity from noisy positions, without looking ahead.

A polynomial is fitted by least squares to the last few frames and differentiated at the newest
(a causal Savitzky-Golay filter: Savitzky and Golay 1964, Anal. Chem. 36:1627-1639, evaluated at
the end of the window). A longer window averages more noise away but bends real motion straight;
a higher order follows the motion better but lets more noise through.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class VelocityEstimator(eqx.Module):
    """Positions in, velocities out, one frame at a time or for whole windows."""

    period: float = eqx.field(static=True)  # s between frames
    frames: int = eqx.field(static=True, default=7)  # in the window
    order: int = eqx.field(static=True, default=2)  # of the polynomial, below `frames`

    @property
    def weights(self) -> np.ndarray:
        """What each frame, oldest first, contributes to the velocity, 1/s: shape (frames,)."""
        time = np.arange(1 - self.frames, 1) * self.period
        return np.linalg.pinv(np.vander(time, self.order + 1, increasing=True))[1]

    def velocity(self, window: Float[Array, "frames *shape"]) -> Float[Array, "*shape"]:
        """Velocity at the newest (last) of `frames` consecutive positions."""
        return jnp.tensordot(jnp.asarray(self.weights, window.dtype), window, axes=1)

    def init(self, position: Float[Array, "*shape"]) -> Float[Array, "frames *shape"]:
        """The carry of an object that has been at rest at `position`."""
        return jnp.broadcast_to(position, (self.frames, *position.shape))

    def update(
        self, carry: Float[Array, "frames *shape"], position: Float[Array, "*shape"]
    ) -> tuple[Float[Array, "frames *shape"], Float[Array, "*shape"]]:
        """The next carry, and the velocity at the frame just seen."""
        carry = jnp.concatenate([carry[1:], position[None]])
        return carry, self.velocity(carry)
