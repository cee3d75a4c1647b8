"""A plant in C99, traced like a law, so that the simulators of others can hold the axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.machine import Machine
from ..native.program import Unknown
from ..pytree.aliases import Array, Leaf, Tree
from ..pytree.named_paths import named_leaves
from ..signals.task import Task
from .c import Code, number
from .c_files import OWN, comment_of
from .law import Field, Function
from .steps import program_of


@dataclasses.dataclass(frozen=True)
class Model:
    """A plant as it is exported: its states, and its step from sample to sample.

    fields: by name, its states at rest
    step: from the states and the input u[k] to the states and the output y[k+1]
    first: (n_y,) output y[0] at rest [unit of y]
    """

    task: Task
    fields: Mapping[str, Field]
    step: Function
    first: np.ndarray

    def response(self, u: np.ndarray) -> np.ndarray:
        """The outputs (N+1, n_y) from rest for inputs (N, n_u), operation by operation."""
        known: dict[str, Leaf] = {name: of.first for name, of in self.fields.items()}
        rows = [self.first]
        for row in u:
            known |= self.step.call({**known, "u": row})
            rows.append(known.pop("y"))
        return np.array(rows)


def model_of(machine: Machine, task: Task) -> Model:
    """The plant of a machine, with the steps of its encoder, traced with the task's sample time.

    The limits of the actuator are a part of the law, and noise is drawn by nobody. Raises Unknown
    for a machine whose disturbances repeat or whose trials differ, and for a plant that cannot be
    written in C.
    """
    for name in ("disturbance", "variation"):
        if getattr(machine, name) is not None:
            raise Unknown(f"the {name} of the machine cannot be a part of one")
    ready = machine.noiseless().sampled(task.dt)
    plant, rest = ready.plant, ready.plant.initial_state()

    def output(x: Tree) -> Array:
        return jnp.reshape(ready.measure(plant.output(x), None), (task.outputs,))

    def step(x: Tree, u: Array) -> tuple[Tree, dict[str, Array]]:
        x = plant.step(x, u, task.dt)
        return x, {"y": output(x)}

    u = jnp.zeros(task.inputs)
    program = program_of(step, rest, u)
    names = list(named_leaves({"x": rest}))
    fields = {name: Field(np.asarray(x, float if np.asarray(x).dtype.kind == "f" else None), "")
              for name, x in zip(names, jax.tree.leaves(rest), strict=True)}  # fmt: skip
    made = Function("step", program, (*names, "u"), (*names, "y"))
    return Model(task, fields, made, np.asarray(output(rest)))


def files_of_plant(model: Model, about: Sequence[str]) -> dict[str, str]:
    """The texts of `plant.h` and `plant.c`."""
    first, task, said = {"y": Field(model.first, "")}, model.task, comment_of(about)
    code = Code(model.fields, [model.step], single=False, also=first)
    header = f"""{said}#ifndef PLANT_H
#define PLANT_H

#include <stdbool.h>
#include <stdint.h>

#ifndef LAW_H
typedef double law_real;
#endif

#define PLANT_INPUTS {task.inputs} /* [{task.input_unit or "1"}] */
#define PLANT_OUTPUTS {task.outputs} /* [{task.unit or "1"}] */
#define PLANT_SAMPLE_TIME {number(task.dt, float, False)} /* [s] */

typedef struct {{
{code.members or "    char nothing; /* the plant has no state */"}
}} plant;

/* The plant at rest, and its output there. */
void plant_start(plant *l, law_real y[PLANT_OUTPUTS]);

/* The output one sample time later, after the input u was held. */
void plant_step(plant *l, const law_real u[PLANT_INPUTS], law_real y[PLANT_OUTPUTS]);

#endif
"""
    head = "void plant_start(plant *l, law_real y[PLANT_OUTPUTS])"
    start = code.start.under(head, ["    (void) l;"])
    head = "void plant_step(plant *l, const law_real u[PLANT_INPUTS], law_real y[PLANT_OUTPUTS])"
    step = code.functions["step"].under(head, ["    (void) l;", "    (void) u;"])
    source = f"""{said}
#include "plant.h"

#include <math.h>

#define LAW_F(name) name
{OWN}
{start}
{step}"""
    return {"plant.h": header, "plant.c": source}
