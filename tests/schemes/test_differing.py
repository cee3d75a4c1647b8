"""Each law on each kind of task or trial that differs: it runs, or refuses and says why.

A pair runs if its shapes do: the law is prepared, and learns from a record of weighed errors, with
shapes and types that stay. What is learned is tested where each kind is.
"""

from functools import cache

import jax
import jax.numpy as jnp
import pytest
from cases import DT, FEW, PLANTS, SCHEMES, case, task_for

from jaxilc.schemes import AtSamples, CrossCoupled, KeepUnmeasured, OnBasis, PolynomialBasis
from jaxilc.schemes.scheme import silent, with_all_parts
from jaxilc.schemes.weights import weighed
from jaxilc.signals.task import Trial

KINDS = {
    "samples that are lost": lambda law: law,
    "what is unmeasured is kept": KeepUnmeasured,
    "points": lambda law: AtSamples(law, windows=(4 * DT, (8 * DT, 10 * DT))),
    "a contour": CrossCoupled,
    "a basis": lambda law: OnBasis(law, PolynomialBasis((0, 1), coupled=True)),
}
NOTHING_LEARNED = "learns no feedforward signal u"
EXPERIMENTS = "ModelFreeGradient makes experiments between its steps"
COMPARES = "FFDLMFAILC, which compares outputs within the trial"
BOUNDS = "y_low of ConstrainedNormOptimal bounds the output"
JERK = "jerk_time = 0.0005 of AtSamples weighs the jerk"
ONE_AXIS = "the model has 1 inputs but the task 2"
# which schemes of cases.py refuse, and what they say; all other pairs run
REFUSED = {
    "what is unmeasured is kept": {
        "model_free": EXPERIMENTS,
        "on_basis": "allowed is OnBasis around KeepUnmeasured",
    },
    "points": {
        "model_free": EXPERIMENTS + ".* at all samples",
        "ffdl_book": COMPARES,
        "ffdl_fir": COMPARES,
        "constrained": BOUNDS,
        "at_samples": JERK,
        "keep_unmeasured": "allowed is KeepUnmeasured around AtSamples",
    },
    "a contour": {
        "ffdl_book": COMPARES,
        "ffdl_fir": COMPARES,
        "model_free": EXPERIMENTS,
        "gradient": ONE_AXIS,
        "constrained": BOUNDS,
        "two_step": ONE_AXIS,
        "at_samples": JERK,
        "warm_start": r"theta has shape \(2,\); allowed is \(4,\)",
        "on_basis": r"functions has shape \(12, 1, 3\); this task needs \(12, 2, m\)",
    },
    "a basis": {
        **dict.fromkeys(
            ("pid_position", "cfdl_mfac", "pfdl_mfac", "ffdl_mfac", "cfdl_mfapc", "smc", "asmc"),
            NOTHING_LEARNED,
        ),
        **dict.fromkeys(("ilc_mfapc", "p_type_over_pid", "dilc", "ilc_asmc"), NOTHING_LEARNED),
        "model_free": EXPERIMENTS,
        "repetitive": "learns no feedforward signal u",
        "repetitive_basis": "learns no feedforward signal u",
    },
}


@cache
def schemes() -> list[str]:
    """The first scheme of each composition of classes."""
    found = {}
    for name in SCHEMES:
        _, scheme, task = case(name)
        parts = tuple(type(part.scheme).__name__ for part in with_all_parts(scheme, task))
        found.setdefault(parts, name)
    return list(found.values())


def turn(scheme, task):
    """What is known before and after a record, of which some errors count less, or not at all."""
    scheme, r = scheme.prepared(task), jnp.asarray(task.reference)
    memory = scheme.initial_memory(task)
    W = jnp.broadcast_to((jnp.arange(FEW + 1) % 3 / 2.0)[:, None], r.shape)
    u = jnp.zeros((task.N, task.inputs))
    trial = weighed(Trial(r, jnp.zeros_like(r), u, task.dt, silent(scheme, task)), W)
    return memory, scheme.learn(memory, trial)


@pytest.mark.thorough(but=["points", "a contour", "a basis"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_law_runs_on_each_kind_or_says_why_not(kind):
    refused = REFUSED.get(kind, {})
    assert set(refused) <= set(schemes())
    for name in schemes():
        plant = case(name)[0].plant
        if kind == "a contour" and plant.n_y == 1:
            plant = PLANTS["mimo"]
        scheme, task = KINDS[kind](SCHEMES[name]), task_for(plant, FEW)
        if name in refused:
            with pytest.raises(ValueError, match=refused[name]):
                scheme.check(task)
            continue
        scheme.check(task)
        before, after = jax.eval_shape(turn, scheme, task)
        assert jax.tree.structure(before) == jax.tree.structure(after), name
        for was, now in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            assert (was.shape, was.dtype) == (now.shape, now.dtype), name
