"""What is set before JAX starts, and functions over many machines."""

import jax.numpy as jnp

from jaxilc.runtime import setup, tiled

# %% setup
setup()  # float64, all cores; before anything else uses JAX

# %% tiled
squares = tiled(
    lambda constant, x: constant * x**2, lanes=16
)  # a `vmap` in tiles, for large batches
print(squares(2.0, jnp.arange(5.0)))
# [ 0.  2.  8. 18. 32.]
