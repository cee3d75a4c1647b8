"""Linear plants as systems of python-control."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ..pytree.aliases import Array, Leaf, Numbers, Tree, Value
from ..pytree.fields import kind_of
from .along_motion import flat
from .linear import TimeVaryingStateSpace
from .modal_model import ModalModel
from .plant import Plant
from .process_model import ProcessModel
from .structure import obstacle

SHORT = 1e-9  # [s] sample time at which the program of a plant in continuous time is looked at


def to_control(plant: Plant, dt: float | None = None) -> Value:
    """The `control.StateSpace` of a linear, time-invariant plant.

        x' = A x + B u  or  x[k+1] = A x[k] + B u[k],    y = C x

    plant: any linear plant, of the package or a user's own
    dt:    sample time [s]: the plant as the simulator steps it, in discrete time. None keeps the
           time of the plant: continuous where it has a form in continuous time
           (`Plant.continuous`), else its own sample time

    The inputs and outputs have the names `Plant.input_names` and `Plant.output_names`, where the
    plant gives them. python-control keeps the initial state apart from a system: it is
    `initial_state(plant, dt)`, for `X0` of `forced_response`.

    Whether the plant is linear is read off its program (`plants.structure`). Raises ValueError for
    a plant that is not, naming its nonlinear parts; for one that varies over the trial or that adds
    a constant; and where a sample time is needed and not given.
    """
    if not isinstance(plant, Plant):
        raise ValueError(f"to_control: {type(plant).__name__} is not a plant of jaxilc")
    own_dt = _own_sample_time(plant)
    continuous = plant.continuous()
    channels = {"inputs": plant.input_names, "outputs": plant.output_names}
    names = {what: list(given) for what, given in channels.items() if given}
    # a dead time is many samples of the shortest sample time, and known to be linear
    if not (isinstance(plant, ProcessModel | ModalModel) and plant.delay):
        _need_linear(plant, dt or own_dt or SHORT)
    if dt is None and continuous is not None:
        return as_system(continuous.A, continuous.B, continuous.C, 0.0, **names)
    if dt is None and not own_dt:
        raise ValueError(
            f"to_control: {type(plant).__name__} has no form in continuous time and no sample time "
            "of its own; give dt, the sample time in s"
        )
    A, B, C = _matrices(plant, dt or own_dt)
    return as_system(A, B, C, dt or own_dt, **names)


def initial_state(plant: Plant, dt: float | None = None) -> np.ndarray:
    """(n,) the state that the system of `to_control(plant, dt)` has before the first sample."""
    continuous = plant.continuous() if dt is None else None
    if continuous is not None:
        return np.asarray(continuous.initial_state())
    return np.asarray(_linearised(plant, dt=dt or _own_sample_time(plant))[-1])


def as_system(A: Leaf, B: Leaf, C: Leaf, dt: float, **names: Value) -> Value:
    """A `control.StateSpace` without feedthrough; dt = 0 is continuous time."""
    import control

    A, B, C = (np.asarray(M, float) for M in (A, B, C))
    D = np.zeros((len(C), B.shape[1]))
    return control.ss(A, B, C, D, float(dt), remove_useless_states=False, **names)


def _need_linear(plant: Plant, dt: float) -> None:
    """Raises ValueError unless each step is a linear map, the same at each sample."""
    if isinstance(plant, TimeVaryingStateSpace):
        raise ValueError(
            "to_control: TimeVaryingStateSpace varies over the trial; allowed are plants that are "
            "the same at each sample"
        )
    parts = _nonlinear_parts(plant, dt)
    if parts:
        raise ValueError(
            f"to_control: {type(plant).__name__} is not linear, because of {', '.join(parts)}; "
            "allowed are linear plants"
        )


def _own_sample_time(plant: Plant) -> float:
    """The sample time [s] that the plant, or a plant within it, is given for; 0 for none."""
    own: float = getattr(plant, "dt", 0.0)
    return own or max(map(_own_sample_time, _plants_within(plant).values()), default=0.0)


def _plants_within(plant: Plant) -> dict[str, Plant]:
    """The plants that a plant is made of, by the names of their fields."""
    if not dataclasses.is_dataclass(plant):
        return {}
    fields = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    return {name: one for name, one in fields.items() if isinstance(one, Plant)}


def _nonlinear_parts(plant: Plant, dt: float) -> list[str]:
    """What makes the plant nonlinear, part by part in words; empty for a linear plant.

    A part is an optional field, which None takes away. Each is looked at by itself, with all the
    others taken away. Where no part is nonlinear by itself, the plant as a whole is.
    """
    whole = _obstacle(plant, dt)
    if not whole or not dataclasses.is_dataclass(plant):
        return [whole] if whole else []
    within = _plants_within(plant).items()
    found = [f"{name}.{part}" for name, one in within for part in _nonlinear_parts(one, dt)]
    optional = [
        f.name
        for f in dataclasses.fields(plant)
        if getattr(plant, f.name) is not None
        and (f.metadata.get("optional") or (kind_of(f) == "child" and f.default is None))
    ]
    for name in optional:
        others = dict.fromkeys(other for other in optional if other != name)
        why = _obstacle(dataclasses.replace(plant, **others), dt)
        if why:
            found.append(f"{name} ({why})")
    return found or [whole]


def _obstacle(plant: Plant, dt: float) -> str:
    """What keeps a step or the output from being affine, in words; empty if nothing does."""

    def start(plant: Plant) -> Array:
        return plant.sampled(dt).initial_state()

    def sample(plant: Plant, now: Tree) -> tuple[Tree, Tree]:
        plant, (x, u) = plant.sampled(dt), now
        return plant.step(x, u, dt), plant.output(x)

    x = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(start, plant))
    return obstacle(sample, plant, (x, jnp.zeros(plant.n_u)))


def _matrices(plant: Plant, dt: float) -> tuple[Numbers, ...]:
    """A (n, n), B (n, n_u), C (n_y, n) of a linear plant, from its own step and output."""
    *matrices, moved, shown, _ = _linearised(plant, dt=dt)
    if np.any(np.asarray(moved)) or np.any(np.asarray(shown)):
        raise ValueError(
            f"to_control: {type(plant).__name__} adds a constant to its state or its output; "
            "allowed are plants that stay at rest without an input"
        )
    return tuple(matrices)


@partial(jax.jit, static_argnames="dt")
def _linearised(plant: Plant, dt: float) -> Tree:
    """A, B, C, what step and output give for a state and an input of zeros, and the start."""
    start, step, output = flat(plant.sampled(dt), dt)
    rest, u = jnp.zeros_like(start), jnp.zeros(plant.n_u)
    A, B = jax.jacfwd(step, (0, 1))(rest, u)
    return A, B, jax.jacfwd(output)(rest), step(rest, u), output(rest), start
