"""Constrained norm-optimal learning: time and accuracy beside general solvers, by trial length.

The case is the double mass of IterativeLearningControl2.jl: its closed loop follows a square wave
with |u| <= 25 and |y| <= 1.1, and the first learning step is solved. Clarabel (interior point) and
OSQP (ADMM with scaling, over-relaxation and adaptive rho) get the same problem in sparse form, with
the states as variables; their rows need `pip install clarabel osqp`. Last come a batch of
uncertain models, and 100,000 samples alone. One process, as many cores as JAX takes.
"""

import argparse
import importlib.util
import time

import jax
import jax.numpy as jnp
import numpy as np
import output
import scipy.signal
import scipy.sparse as sparse

import jaxilc
from jaxilc.plants import StateSpace
from jaxilc.schemes import ConstrainedNormOptimal
from jaxilc.signals import Task
from jaxilc.signals.task import Trial

LANES = 16  # machines that are solved together, as sweeps do on a CPU
DT, W_Q, W_R, LIMIT, HIGHEST = 0.02, 1000.0, 0.001, 25.0, 1.1


def closed_loop(load=1.0):
    """The discrete loop: A, its inputs from r and from u, and C."""
    k, c, m, J = 100.0, 1.0, 1.0, load
    A = np.array(
        [
            [0, 1, 0, 0],
            [-k / m, -2 * c / m, k / m, c / m],
            [0, 0, 0, 1],
            [k / J, c / J, -k / J, -2 * c / J],
        ]
    )
    B, C = np.array([[0.0], [1 / m], [0], [0]]), np.array([[1.0, 0, 0, 0]])
    a, b, c, d = scipy.signal.tf2ss(10 * np.polymul([1, 1], [1, 1]), np.polymul([1, 0], [DT, 1]))
    loop = np.block([[A - B @ d @ C, B @ c], [-b @ C, a]])
    both = np.hstack([np.vstack([B @ d, b]), np.vstack([B, np.zeros((2, 1))])])
    rows = np.hstack([C, np.zeros((1, 2))])
    A, B, C, _, _ = scipy.signal.cont2discrete((loop, both, rows, np.zeros((1, 2))), DT)
    return A, B[:, :1], B[:, 1:], C


def first_trial(N):
    """The reference, and the output without a learned input, both (N+1, 1)."""
    A, B, _, C = closed_loop()
    r = np.sign(np.sin(DT * np.arange(N + 1)))
    return r[:, None], scipy.signal.dlsim((A, B, C, np.zeros((1, 1)), DT), r)[1]


def scheme_of(load=1.0):
    A, _, B, C = closed_loop(load)
    return ConstrainedNormOptimal(
        StateSpace(A, B, C, dt=DT), w_q=W_Q, w_r=W_R, limit=LIMIT, y_low=-HIGHEST, y_high=HIGHEST
    )


@jax.jit
def learned(scheme, memory, r, y):
    return scheme.learn(memory, Trial(r, y, jnp.zeros((len(r) - 1, 1)), DT))


def timed(call, repeats=3):
    """What `call` returns, and the shortest of a few times [s]; the first run is left out."""
    found, times = jax.block_until_ready(call()), []
    for _ in range(repeats):
        start = time.perf_counter()
        found = jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return found, min(times)


def of_package(N):
    (r, y), scheme = first_trial(N), scheme_of()
    memory = scheme.initial_memory(Task(r, dt=DT))
    scheme = scheme.prepared(Task(r, dt=DT))
    found, seconds = timed(lambda: learned(scheme, memory, r, y))
    return np.asarray(found.u), int(found.steps), seconds, bool(found.converged)


def sparse_problem(N):
    """P, q, A, low, high of the variables d[0..N-1], x[1..N], for low <= A z <= high."""
    (A, _, B, C), (r, y) = closed_loop(), first_trial(N)
    n, eye = len(A), sparse.identity(N, format="csc")
    P = sparse.block_diag([W_R * eye, sparse.kron(eye, W_Q * C.T @ C)], format="csc")
    q = np.concatenate([np.zeros(N), np.kron((r - y)[1:, 0], -W_Q * C[0])])
    motion = sparse.hstack(
        [sparse.kron(eye, B), sparse.kron(sparse.eye(N, k=-1), A) - sparse.identity(N * n)]
    )
    bounds = sparse.block_diag([eye, sparse.kron(eye, C)])
    zero, y = np.zeros(N * n), y[1:, 0]
    low = np.concatenate([zero, np.full(N, -LIMIT), -HIGHEST - y])
    high = np.concatenate([zero, np.full(N, LIMIT), HIGHEST - y])
    return P, q, sparse.vstack([motion, bounds], format="csc"), low, high


def of_clarabel(N):
    import clarabel

    P, q, A, low, high = sparse_problem(N)
    n, settings = N * len(closed_loop()[0]), clarabel.DefaultSettings()
    settings.verbose = False
    rows = sparse.vstack([A[:n], A[n:], -A[n:]], format="csc")
    b = np.concatenate([low[:n], high[n:], -low[n:]])
    cones = [clarabel.ZeroConeT(n), clarabel.NonnegativeConeT(len(b) - n)]
    upper = sparse.triu(P).tocsc()
    found, seconds = timed(
        lambda: clarabel.DefaultSolver(upper, q, rows, b, cones, settings).solve()
    )
    return np.array(found.x[:N])[:, None], found.iterations, seconds, "Solved" in str(found.status)


def of_osqp(N):
    import osqp

    P, q, A, low, high = sparse_problem(N)
    start = time.perf_counter()
    solver = osqp.OSQP()
    solver.setup(P, q, A, low, high, verbose=False, eps_abs=1e-6, eps_rel=1e-6, max_iter=20_000)
    found = solver.solve()
    seconds = time.perf_counter() - start
    return found.x[:N, None], found.info.iter, seconds, found.info.status == "solved"


def cost_and_violation(u):
    """The cost of an input (N, 1), and by how much it leaves a bound."""
    (A, _, B, C), (r, y) = closed_loop(), first_trial(len(u))
    y = y + scipy.signal.dlsim((A, B, C, np.zeros((1, 1)), DT), np.append(u, 0.0))[1]
    beyond = max(np.max(np.abs(u)) - LIMIT, np.max(np.abs(y)) - HIGHEST)
    return (W_Q * np.sum((r - y)[1:] ** 2) + W_R * np.sum(u**2)) / 2, max(beyond, 0.0)


def batched(size, N):
    """Seconds for a batch of models whose load differs, iterations of the slowest, and how many."""
    r, y = first_trial(N)
    loads = np.random.default_rng(1).uniform(0.7, 1.5, size)
    schemes = jax.tree.map(lambda *leaves: np.stack(leaves), *map(scheme_of, loads))
    memory = scheme_of().initial_memory(Task(r, dt=DT))
    all_of_them = jax.jit(
        lambda schemes: jax.lax.map(lambda s: learned(s, memory, r, y), schemes, batch_size=LANES)
    )
    found, seconds = timed(lambda: all_of_them(schemes), repeats=1)
    return seconds, int(np.max(found.steps)), int(np.sum(found.converged))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lengths", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--longest", type=int, default=100_000)
    parser.add_argument("--batch", type=int, default=256)
    asked = parser.parse_args()
    jaxilc.setup()
    folder, rows = output.folder(__file__), []
    solvers = {"jaxilc": of_package, "clarabel": of_clarabel, "osqp": of_osqp}
    for N in (*asked.lengths, asked.longest):
        best = None
        for name, solver in solvers.items():
            if name != "jaxilc" and (asked.longest == N or not importlib.util.find_spec(name)):
                continue
            u, steps, seconds, converged = solver(N)
            cost, beyond = cost_and_violation(u)
            best = cost if best is None else best
            row = {"N": N, "solver": name, "seconds": seconds, "iterations": steps}
            row |= {"converged": converged, "cost": cost, "relative to jaxilc": cost / best - 1}
            rows.append(row | {"beyond a bound": beyond})
    output.write_rows(folder / "rows.csv", rows)
    if asked.batch:
        N = asked.lengths[-1]
        seconds, steps, converged = batched(asked.batch, N)
        row = {"batch": asked.batch, "N": N, "seconds": seconds, "iterations": steps}
        output.write_rows(folder / "batch.csv", [row | {"converged": converged}])


if __name__ == "__main__":
    main()
