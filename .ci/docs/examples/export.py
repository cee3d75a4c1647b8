"""A law as a C program, with its guard, test vectors and certificate."""

import jax.numpy as jnp
import numpy as np

import jaxilc
from jaxilc import Task
from jaxilc.export import Law, check, files_of, interpret, law_of, program_of
from jaxilc.schemes import PIDType

jaxilc.setup()
task = Task(np.sin(np.linspace(0, 2 * np.pi, 21)), dt=1e-3, unit="mm", input_unit="V")

# %% law_of, Law
law = law_of(PIDType(gamma_p=0.5), task, limit=np.array([2.0]))
print(isinstance(law, Law), [function.name for function in law.functions])
# True ['begin', 'sample', 'end']

# %% files_of
texts = files_of(law, ["a P-type law"], "0" * 64, [0.9 * np.asarray(task.reference)])
print(sorted(texts))
# ['law.c', 'law.h', 'law_test.c']

# %% program_of, interpret
program = program_of(lambda a, b: a * b + 1, jnp.ones(3), jnp.arange(3.0))
print(interpret(program, [np.ones(3), np.arange(3.0)])[0])
# [1. 2. 3.]

# %% check
try:
    check("nowhere")  # the claims of a folder that `jaxilc export` wrote
except FileNotFoundError as error:
    print(type(error).__name__)
# FileNotFoundError
