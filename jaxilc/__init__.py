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

import lazy_loader

_named, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name != "__version__":
        return _named(name)
    from importlib.metadata import version  # which takes as long as all that is above

    return version(__name__)
