"""Learned on some references, judged on others: basis functions against sample-wise learning.

Each of the machines drawn learns on three motions, eight trials each, with what it has learned
taken along. Then come references that it has never seen: the table has the error of the first
trial on them, and the number of trials that sample-wise learning, which must start anew, needs to
become as good. Rows and a figure are written to out/experiments/basis_functions.
"""

import jax
import numpy as np
from output import axes, folder, write_rows

import jaxilc

jaxilc.setup()

from jaxilc import Machine, Sensor, Task, Uniform, learn  # noqa: E402
from jaxilc.plants import StateSpace  # noqa: E402
from jaxilc.schemes import (  # noqa: E402
    BasisFunctions,
    NormOptimal,
    PolynomialBasis,
    RationalBasis,
    WarmStart,
    fitted,
)
from jaxilc.uncertainty import draw, drawn_machines  # noqa: E402

DT, SEED, MACHINES, TRIALS, FRESH = 1e-3, 11, 64, 8, 30
MASS, DAMPING, STIFFNESS, GAIN = 2.0, 30.0, 3.0e4, 60.0  # kg, N s/m, N/m; N/V
REST, DEGREES = 0.1, [0, 0, 0, 0, 0, 126, -420, 540, -315, 70]


def plant() -> StateSpace:
    """A stage on a stiff position loop with an elastic load, in mm and V."""
    load, k, c = 0.3, 4.0e4, 12.0
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = np.array([-STIFFNESS - k, -DAMPING - c, k, c]) / MASS
    A[3] = np.array([k, c, -k, -c]) / load
    B = np.array([[0.0], [1e3 * GAIN / MASS], [0.0], [0.0]])
    return StateSpace(A, B, np.array([[1.0, 0.0, 0.0, 0.0]]))


def motion(height: float, move: float, samples: int) -> Task:
    """There and back with four derivatives at rest; heights in mm, times in s."""
    t = np.arange(samples + 1) * DT
    rise = np.polynomial.Polynomial(DEGREES)
    there = rise(np.clip((t - REST) / move, 0, 1))
    back = rise(np.clip((t - t[-1] + REST + move) / move, 0, 1))
    return Task(height * (there - back), DT, unit="mm", input_unit="V")


LEARNED = [motion(5.0, 0.15, 600), motion(-12.0, 0.2, 700), motion(20.0, 0.25, 800)]
UNSEEN = {
    "larger": motion(30.0, 0.25, 800),
    "quicker": motion(8.0, 0.12, 500),
    "the other way, slower": motion(-20.0, 0.4, 1200),
}


def main() -> None:
    nominal = plant()
    machine = Machine(nominal, sensor=Sensor(noise=1e-4))
    spread = {
        "plant.B": Uniform(0.8, 1.2, relative=True),
        "plant.A": Uniform(0.97, 1.03, relative=True),
    }
    drawn = drawn_machines(machine, spread, draw(machine, spread, MACHINES, seed=SEED))
    model = nominal.sampled(DT)
    bases = {
        "position to acceleration": PolynomialBasis((0, 1, 2)),
        "position to snap": PolynomialBasis((0, 1, 2, 3, 4)),
        "rational": RationalBasis(PolynomialBasis((0, 1, 2, 3, 4)), order=2),
    }
    sample_wise = NormOptimal(model, w_r=1e-3)

    def rms(machines, scheme, task, trials, memory=None):
        def one(machine, memory, i):
            key = jax.random.fold_in(jax.random.key(SEED), i)
            history = learn(machine, scheme, task, trials, key=key, memory=memory)
            return history.rms[:, 0], history.memory

        return jax.jit(jax.vmap(one))(machines, memory, np.arange(MACHINES))

    rows, fresh, kept = [], {}, {}
    for name, task in UNSEEN.items():
        fresh[name] = np.asarray(rms(drawn, sample_wise, task, FRESH)[0])
    for label, basis in bases.items():
        scheme, memory = BasisFunctions(basis, model), None
        for task in LEARNED:
            _, memory = rms(drawn, scheme, task, TRIALS, memory)
        kept[label] = memory
        for name, task in UNSEEN.items():
            errors = np.asarray(rms(drawn, scheme, task, 1, memory)[0])[:, 0]
            as_good = (fresh[name] <= errors[:, None]).argmax(1)
            as_good = np.where((fresh[name] <= errors[:, None]).any(1), as_good + 1, FRESH + 1)
            rows.append(
                {
                    "basis": label,
                    "unseen": name,
                    "first trial without, um": 1e3 * float(np.median(fresh[name][:, 0])),
                    "first trial with, um": 1e3 * float(np.median(errors)),
                    "worst, um": 1e3 * float(errors.max()),
                    "as good anew in trial": float(np.median(as_good)),
                }
            )
    target = folder(__file__)
    write_rows(target / "unseen.csv", rows)

    # Sample-wise learning that starts from theta, and a fit of theta to an input learned so.
    name, task = "larger", UNSEEN["larger"]
    basis = bases["position to snap"]
    theta = np.median(np.asarray(kept["position to snap"].theta), axis=0)
    warm = np.asarray(rms(drawn, WarmStart(sample_wise, basis, theta), task, FRESH)[0])
    learned = learn(machine, sample_wise, LEARNED[2], FRESH)
    r = LEARNED[2].reference
    refitted = fitted(basis, learned.memory.u, r, DT)
    after = learn(machine, BasisFunctions(basis, model, start=refitted), task, 1).rms[0, 0]
    print(f"theta fitted to a learned input, first trial on '{name}': {1e3 * float(after):.3g} um")
    ax = axes()
    for label, errors in (("anew", fresh[name]), ("warm start from theta", warm)):
        ax.semilogy(1 + np.arange(FRESH), 1e3 * np.median(errors, axis=0), label=label)
    ax.set(xlabel="trial", ylabel="median rms error [um]", title="NormOptimal on an unseen motion")
    ax.legend()
    ax.figure.savefig(target / "warm_start.png")


if __name__ == "__main__":
    main()
