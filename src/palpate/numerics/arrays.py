"""NumPy's arrays on JAX's devices, without compiling anything for their shapes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array


def as_array(values: Any, dtype: DTypeLike | None = None) -> Array:
    """The numbers as an array of JAX, in memory of their own, of a `dtype` or their own one.

    As `jnp.asarray`, which with JAX 0.10 compiles a conversion of NumPy's double precision, and a
    copy where no dtype is given, for each shape anew: 20 ms each time. Arrays of JAX, and what is
    traced, are converted as there.
    """
    if isinstance(values, jax.Array):
        return jnp.asarray(values, dtype)
    values = np.asarray(values)
    kind = jax.dtypes.canonicalize_dtype(values.dtype if dtype is None else dtype)
    # A copy: JAX may go on using the memory that it is given, which its owner may write to.
    return jnp.asarray(np.array(values, kind), kind)
