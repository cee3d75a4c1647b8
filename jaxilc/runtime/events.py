"""Names of the events that a sweep records with `jax.monitoring`, each with its seconds.

The command line listens to them for `--verbose`.
"""

COMPILING = "/jaxilc/sweep/compiling"  # the programs of a sweep were compiled, or loaded
COMPUTING = "/jaxilc/sweep/computing"  # the devices computed a chunk
