"""A differentiable batch simulator for iterative learning control of machine-tool feed drives.

A plant steps. A scheme acts within a trial and learns between trials. `learn` repeats trials.
Everything is a pytree of float arrays, so `vmap` runs thousands of plants at once and `grad` goes
through the whole learning process.

    import jaxilc
    jaxilc.setup()                                     # float64, all cores
    s = jaxilc.scenarios.load("cao-2019")
    history = jaxilc.learn(s.machine, s.schemes["ffdl-mfailc"], s.task, trials=60)
    history.settled_error                              # (60, 1), in mm

The names are listed in `__init__.pyi` and imported on first use, so that `jaxilc --help` need not
wait for JAX.
"""

from importlib.metadata import version

import lazy_loader

__version__ = version(__name__)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
