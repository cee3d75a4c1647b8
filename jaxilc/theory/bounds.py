"""The bounds d1 and d2 of Cao 2019 from the plant, and beside them what a run shows.

The theory takes D y(k+1, j) = phi(k, j) D u(k, j) for a pseudo partial derivative (PPD) phi that is
bounded, of constant sign and away from zero. Dividing D y by D u of a run always gives such a phi,
so that a d2 made of it is the observed ratio of the errors and checks nothing. Here phi is the
derivative of the plant, dy(k+1)/du(k): the diagonal of the trial map. What the map has off its
diagonal, the reaction to earlier inputs, is what the theory leaves out.

The diagonal of the frozen law's map of errors, I - G diag(gamma), is 1 - gamma phi, and the map is
lower triangular, without a lead. So d2 bounds its eigenvalues, on every plant; it bounds the error
where there is nothing off the diagonal. How far the error grows before it falls is told by the
largest singular value.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ..learning.machine import Machine
from ..learning.metrics import Watch, Watched, largest
from ..learning.over_trials import learn
from ..learning.within_trial import run_trial
from ..plants.structure import obstacle
from ..pytree.aliases import Leaf, Tree, Value
from ..pytree.in_short import in_short
from ..runtime.tiles import tiled_with
from ..schemes import CFDLMFAILC, CFDLMFAPC, FFDLMFAC, FFDLMFAILC, PFDLMFAILC, Scheme
from ..schemes.scheme import Feedforward
from ..signals.task import Task, Trial
from ..uncertainty import Uncertainty, drawn_machines
from .chance import noise_of
from .contraction import error_map
from .linearity import output_alone
from .loop import tick_of
from .spectrum import SingularValue, singular_value

RIDGE = 500.0  # last places of the variance of a window, whose increments may follow from others
ROUNDING = 1e3  # in units of the last place of the largest output
CLEAR = 1e3  # as many times larger is an error whose ratio to the next one is looked at
TURNS = 20  # bits of a quantile: 8 of its exponent, 12 of its fraction
HIGH = 0.95  # share of the samples below the high quantile
UNPROVED = np.nan  # what no paper proves of a scheme, and the share of no premise of it


class PseudoGradient(NamedTuple):
    """How the output of a machine follows from a window of increments, along a trial.

        D y(k+1) = Phi(k) . D H(k) + rest,  D H(k) = D y(k), ..., D y(k-L_y+1), D u(k), ...,
                                                     D u(k-L_u+1)

    Phi is that with the smallest rest for increments D u that are white, of variance 1. Its
    component c = L_y is the derivative dy(k+1)/du(k), whatever the window.

    Phi:  (N, L_y+L_u), the components in the order of D H [1 and unit of y per unit of u]
    rest: (N,) variance of the rest; for the window of one, the sum of the squares of the row of the
          trial map off its diagonal
    total: (N,) variance of D y(k+1), the sum of the squares of the whole row
    """

    Phi: jax.Array
    rest: jax.Array
    total: jax.Array
    __repr__ = in_short


def pseudo_gradient_of(
    machine: Machine, task: Task, *, L_y: int = 0, L_u: int = 1, u: Value = None
) -> PseudoGradient:
    """The pseudo gradient of a machine along a trial, from the derivatives of its own step.

    One scan over the samples, whatever N: the state x of the machine is linearised at each sample,
    x' = A x + B D u, and its covariance, with that of the window, is carried along, P' = F P F^T +
    g g^T. That gives the sum of the squares of each row of the trial map without the row. For the
    window of one, and a machine whose program is linear and the same at each sample, the impulse
    response is enough.

    u: (N, 1) input of the trial at which a machine that is not linear is linearised; None: zero

    The function is pure: it may be vmapped and differentiated. A state of n numbers costs n^3 a
    sample. Raises ValueError for a task with more than one input or output.
    """
    _need_one_channel(task)
    machine = jax.tree.map(jnp.asarray, machine)  # an array of NumPy has no row of a traced number
    tick, fixed, rest = tick_of(machine, None, task)

    def following(x, w, d):
        return tick(fixed, rest._replace(x=x, w=w, d_u=d))[0]

    def output(x):
        return tick(fixed, rest._replace(x=x))[1][0]

    def slopes(x, w, d):
        A, B = jax.jacfwd(following, argnums=(0, 1))(x, w, d)
        return A, B[:, 0]

    if L_y + L_u == 1 and not obstacle(*tick_of(machine.unrounded(), None, task)):
        A, B = slopes(rest.x, rest.w, rest.d_u)
        c = jax.grad(output)(rest.x)
        g = lax.scan(lambda x, _: (A @ x, c @ x), B, length=task.N)[1]
        off = jnp.cumsum(g.at[0].set(0.0) ** 2)  # a difference to the whole would be rounding
        return PseudoGradient(jnp.broadcast_to(g[0], (task.N, 1)), off, off + g[0] ** 2)
    d_u = machine.noiseless().draws(jax.random.key(0), task).input
    d_u = jnp.zeros((task.N, 1)) if d_u is None else d_u
    u = jnp.zeros((task.N, 1)) if u is None else jnp.asarray(u)
    n, inputs = len(rest.x), L_u - 1
    outputs = max(L_y - 1, 0)  # of the past; y(k) follows from the state
    past = outputs + inputs
    shift = np.eye(past, k=-1)
    shift[outputs : outputs + 1] = 0.0  # the newest input of the past does not come from an output

    def sample(carry, now):
        x, P = carry
        (A, B), after = slopes(x, *now), following(x, *now)
        c, row = jax.grad(output)(x), jax.grad(output)(after)
        of_past = jnp.pad(row @ A, (0, past))
        W = jnp.eye(past, n + past, n)
        W = jnp.concatenate([jnp.pad(c, (0, past))[None], W]) if L_y else W
        found = row @ B, of_past @ P @ of_past, W @ P @ W.T, W @ (P @ of_past)
        F = jnp.block([[A, jnp.zeros((n, past))], [jnp.zeros((past, n)), shift]])
        F = F.at[n, :n].set(c) if outputs else F
        g = jnp.pad(B, (0, past))
        g = g.at[n + outputs].set(1.0) if inputs else g
        return (after, F @ P @ F.T + jnp.outer(g, g)), found

    P = jnp.zeros((n + past,) * 2)
    direct, before, known, common = lax.scan(sample, (rest.x, P), (u, d_u))[1]
    weights = jax.vmap(_best)(known, common)
    guessed = jnp.einsum("ki,kij,kj->k", weights, known, weights)
    left = before - 2 * jnp.sum(weights * common, axis=1) + guessed
    Phi = jnp.concatenate([weights[:, :L_y], direct[:, None], weights[:, L_y:]], axis=1)
    return PseudoGradient(Phi, jnp.maximum(left, 0.0), before + direct**2)


class Bounds(NamedTuple):
    """What Cao 2019 says of a scheme on a machine, from the plant and before any trial; all ().

    ppd_low, ppd_high: interval of dy(k+1)/du(k) along the trial [unit of y per unit of u]
    left_out: share of the variance of D y that the window of the scheme leaves out, for increments
              D u that are white; for a window of one, the share of the squares off the diagonal
    b:        of the Lipschitz premise |D y(k+1)| <= b |D H(k)|: the largest |Phi|
    lam_min:  b^2 / 4
    M1:       smallest phi phi_hat / (lam + phi_hat^2); the estimate lies between its start and phi,
              since each step with eta <= 1 is a mean of both, and each reset goes to the start
    d1:       |1 - eta h^2 / (mu + h^2)| at most, for |D H| = h >= epsilon: how the error of the
              estimate contracts along D H; across it, nothing contracts
    d2:       |1 - rho phi phi_hat / (lam + phi_hat^2)| at most, which is 1 - rho M1 where
              lam > lam_min (eq. 15)
    ppd_start: |phi_hat(1) - phi| at most
    ppd_rest:  2 b / (1 - d1), see `ppd_bound`
    radius:   spectral radius of the map of errors of the law frozen at its start
    linear:   1 where the output is affine in the input, without limit, rounding, noise or change
    alone:    1 where y(k+1) depends on u(k) alone
    signs:    1 where phi keeps its sign, away from zero, and the start of the estimate has it too
    damped:   1 where lam > lam_min
    printed:  1 where the law is the printed one: window of one, no lead, no limit, eta <= 1
    claimed:  1 where these five hold, so that |e(k+1,j)| <= d2 |e(k+1,j-1)| at every sample

    What no paper proves of a scheme is NaN.
    """

    ppd_low: jax.Array
    ppd_high: jax.Array
    left_out: jax.Array
    b: jax.Array
    lam_min: jax.Array
    M1: jax.Array
    d1: jax.Array
    d2: jax.Array
    ppd_start: jax.Array
    ppd_rest: jax.Array
    radius: jax.Array
    linear: jax.Array
    alone: jax.Array
    signs: jax.Array
    damped: jax.Array
    printed: jax.Array
    claimed: jax.Array
    __repr__ = in_short


def bounds_of(machine: Machine, scheme: Scheme, task: Task, u: Value = None) -> Bounds:
    """The bounds of Cao 2019, eq. 9 and 13 to 15, of a scheme on a machine.

    They need no trial. For FFDL- and PFDL-MFAILC the paper bounds the pseudo gradient (Theorem 2)
    and says nothing of the error, so M1 and d2 are NaN. Dai 2014 has no theorem: of MFAC and MFAPC
    only the d1 of their estimator is told, and of any other scheme, ILC-MFAPC included, only the
    plant.

    u: as for `pseudo_gradient_of`; a machine that is not linear has another interval along another
       trial, so nothing is claimed of it

    The function is pure. Raises ValueError for a task with more than one input or output.
    """
    learns = isinstance(scheme, FFDLMFAILC)
    L_y, L_u = _window(scheme)
    Phi, rest, every = pseudo_gradient_of(machine, task, L_y=L_y, L_u=L_u, u=u)
    phi = Phi[:, L_y]
    low, high = -largest(-phi), largest(phi)
    b = largest(jnp.linalg.norm(Phi, axis=1)) if L_y + L_u > 1 else largest(jnp.abs(phi))
    total = jnp.sum(every)
    left_out = jnp.sum(rest) / jnp.where(total > 0, total, 1.0)
    unproved, slight = jnp.full((), UNPROVED), ROUNDING * jnp.finfo(phi.dtype).eps
    found = dict.fromkeys(Bounds._fields, unproved) | {
        "ppd_low": low,
        "ppd_high": high,
        "left_out": left_out,
        "b": b,
        "lam_min": b**2 / 4,
        "linear": jnp.asarray(_linear(machine, task)),
        "alone": task.N * largest(rest) <= (slight * jnp.min(jnp.abs(phi))) ** 2,
    }
    if isinstance(scheme, FFDLMFAILC | FFDLMFAC | CFDLMFAPC):
        eta, mu, square = _first(scheme.eta), _first(scheme.mu), _first(scheme.epsilon) ** 2
        gap = jnp.minimum(eta * square / (mu + square), 2.0 - eta)
        found |= {"d1": 1.0 - gap}
    if learns:
        start = jnp.atleast_1d(scheme.phi0)[L_y]
        lam, rho = _first(scheme.lam), jnp.broadcast_to(scheme.rho, (L_y + L_u,))[L_y]
        one = 1.0 - rho * phi * start / (lam + start**2)
        far = jnp.minimum(jnp.abs(low), jnp.abs(high)) > _first(scheme.epsilon)
        signs = (low * high > 0) & far & (low * start > 0)
        own = type(scheme) in (CFDLMFAILC, FFDLMFAILC, PFDLMFAILC)  # no law of a user's own
        printed = own and compact(scheme) and scheme.lead == 0 and scheme.limit is None
        found |= {
            "radius": largest(jnp.abs(one)) if scheme.lead == 0 else unproved,
            "signs": signs,
            "damped": lam > b**2 / 4,
            "printed": (eta <= 1.0) & printed,
        }
        if compact(scheme):
            ends = jnp.stack([jnp.minimum(start, low), jnp.maximum(start, high)])
            products = jnp.stack([low, high])[:, None] * _gains(ends, lam)
            M1, most = -largest(-products), largest(products)
            found |= {
                "M1": M1,
                "d2": jnp.maximum(jnp.abs(1.0 - rho * M1), jnp.abs(1.0 - rho * most)),
                "ppd_start": largest(jnp.abs(start - phi)),
                "ppd_rest": 2 * b / gap,
            }
    of_plant_and_law = ("linear", "alone", "signs", "damped", "printed")
    held = {name: jnp.asarray(found[name], Phi.dtype) for name in of_plant_and_law}
    claimed = jnp.all(jnp.stack([*held.values()]) == 1.0)
    return Bounds(**found | held | {"claimed": claimed.astype(Phi.dtype)})


def ppd_bound(bounds: Bounds, trials: int) -> jax.Array:
    """(J,) d1^(j-1) |phi_hat(1) - phi| + 2 b / (1 - d1) for j = 1..J (Cao 2019, after eq. 14).

    It bounds the error of the estimate that trial j uses, as long as |D u| >= epsilon.
    """
    return bounds.d1 ** jnp.arange(trials) * bounds.ppd_start + bounds.ppd_rest


def frozen_growth(
    machine: Machine, scheme: Scheme, task: Task, *, steps: int = 300, tolerance: float = 1e-6
) -> SingularValue:
    """The largest |e_(j+1)| / |e_j| of the law frozen at its start: what d2 should have been.

    It is sigma_max of I - G diag(gamma), found without the matrix; `lifted.mfailc_map` has it.

    steps, tolerance: as for `spectrum.singular_value`
    """
    at = error_map(machine, scheme.frozen(), task)
    return singular_value(*at, steps=steps, tolerance=tolerance, row=0)


# What a run shows
# ------------------------------------------------------------------------------

OF_TRIALS = {
    "contraction_median": "median over the samples of |e_j| / |e_(j-1)|",
    "contraction_high": "95 % quantile over the samples of |e_j| / |e_(j-1)|",
    "contraction_worst": "largest |e_j| / |e_(j-1)| of a sample",
    "contraction_norm": "2-norm of e_j over that of e_(j-1)",
    "share_lipschitz": "share of samples with |D y(k+1)| <= b |D H(k)|, b from the plant",
    "share_sign": "share of samples at which D y(k+1) has the sign of phi D u(k)",
    "share_excited": "share of samples with |D H(k)| >= epsilon",
    "share_kept": "share of samples with |e_j| <= d2 |e_(j-1)|, d2 from the plant",
}
OF_MACHINES = {
    "ppd_low": "smallest dy(k+1)/du(k) along the trial",
    "ppd_high": "largest dy(k+1)/du(k) along the trial",
    "left_out": "share of the variance of D y that the window of the scheme leaves out",
    "b": "largest pseudo gradient along the trial",
    "lam_min": "b^2 / 4 of Cao 2019",
    "M1": "M1 of Cao 2019 from the plant",
    "d1": "d1 of Cao 2019",
    "d2": "d2 of Cao 2019 from the plant",
    "ppd_start": "error of the estimate at the start",
    "ppd_rest": "2 b / (1 - d1) of Cao 2019",
    "radius": "spectral radius of the law frozen at its start",
    "linear": "whether the machine is linear, without limit, rounding, noise or change",
    "alone": "whether y(k+1) depends on u(k) alone",
    "signs": "whether phi keeps its sign, away from zero, and the estimate starts with it",
    "damped": "whether lam > b^2 / 4",
    "printed": "whether the law is CFDL-MFAILC as printed, without lead and limit",
    "claimed": "whether |e_j| <= d2 |e_(j-1)| is claimed",
    "sigma_max": "largest singular value of the map of errors of the law frozen at its start",
}


@dataclasses.dataclass(frozen=True)
class BoundsWatch(Watch):
    """Contraction and premises, trial by trial, beside the bounds from the plant.

    The ratio of two errors is looked at where the first is above rounding; NaN where none is. The
    names are those of `OF_MACHINES` and `OF_TRIALS`.

    sigma_steps: Lanczos steps for `sigma_max`, each as long as two trials and more; 0: without it
    """

    sigma_steps: int = 0

    def variables(self, task: Task) -> dict[str, Watched]:
        _need_one_channel(task)
        slope = f"{task.unit}/{task.input_unit}"
        units = dict.fromkeys(("ppd_low", "ppd_high", "ppd_start", "ppd_rest", "b"), slope)
        units["lam_min"] = f"({slope})^2"
        found = {
            name: Watched(False, units.get(name, ""), text)
            for name, text in OF_MACHINES.items()
            if name != "sigma_max" or self.sigma_steps
        }
        return found | {name: Watched(True, "", text) for name, text in OF_TRIALS.items()}

    def known(self, machine: Machine, scheme: Scheme, task: Task) -> dict[str, jax.Array]:
        found = bounds_of(machine, scheme, task)._asdict()
        if self.sigma_steps:
            found["sigma_max"] = frozen_growth(machine, scheme, task, steps=self.sigma_steps).value
        return found

    def continued(
        self,
        known: Mapping[str, jax.Array],
        machine: Machine,
        scheme: Scheme,
        task: Task,
        memory: Tree,
    ) -> dict[str, jax.Array]:
        """Nothing is claimed of a memory of another machine, which d2 knows nothing of.

        Of this machine are y, which follows from u, and an estimate between the start and phi.
        """
        if not (isinstance(scheme, FFDLMFAILC) and compact(scheme)):
            return dict(known)
        y = run_trial(machine, Scheme(), task, Feedforward(memory.u), jax.random.key(0)).y
        start, phi, low, high = scheme.phi0, memory.phi[0], known["ppd_low"], known["ppd_high"]
        least, most = jnp.minimum(jnp.min(start), low), jnp.maximum(jnp.max(start), high)
        rounding = ROUNDING * jnp.finfo(phi.dtype).eps
        slack = rounding * jnp.maximum(jnp.abs(least), jnp.abs(most))
        own = jnp.all((phi >= least - slack) & (phi <= most + slack))
        own &= jnp.max(jnp.abs(memory.y - y)) <= rounding * jnp.max(jnp.abs(y))
        own |= memory.seen == 0  # which holds no trial
        return {**known, "claimed": jnp.where(own, known["claimed"], 0.0)}

    def seen(
        self, known: Mapping[str, jax.Array], scheme: Scheme, before: Trial, trial: Trial
    ) -> dict[str, jax.Array]:
        L_y, L_u = _window(scheme)
        dy, du = (trial.y - before.y)[:, 0], (trial.u - before.u)[:, 0]
        window = [_earlier(dy[:-1], i) for i in range(L_y)]
        window += [_earlier(du, i) for i in range(L_u)]
        moved = jnp.linalg.norm(jnp.stack(window), axis=0)
        dy, now, last = dy[1:], jnp.abs(trial.e[1:, 0]), jnp.abs(before.e[1:, 0])
        slack = ROUNDING * jnp.finfo(dy.dtype).eps * (jnp.max(jnp.abs(trial.y)) + jnp.max(last))
        clear = last > CLEAR * slack
        ratio = jnp.where(clear, now / jnp.where(clear, last, 1.0), jnp.inf)
        count = jnp.sum(clear)
        ranks = jnp.stack([(count - 1) // 2, jnp.ceil(HIGH * count).astype(int) - 1])
        worst = jnp.max(jnp.where(clear, ratio, 0.0))
        norm = jnp.linalg.norm(now) / jnp.linalg.norm(last)
        found = jnp.concatenate([_ranked(ratio, ranks), jnp.stack([worst, norm])])
        median, high, worst, norm = jnp.where(count > 0, found, jnp.nan)
        same = (dy * du * (known["ppd_low"] + known["ppd_high"]) > 0) | (jnp.abs(dy) <= slack)
        kept = _share(now <= known["d2"] * last + slack)
        learns = isinstance(scheme, FFDLMFAILC)
        excited = _share(moved >= _first(scheme.epsilon)) if learns else jnp.full((), UNPROVED)
        return {
            "contraction_median": median,
            "contraction_high": high,
            "contraction_worst": worst,
            "contraction_norm": norm,
            "share_lipschitz": _share(jnp.abs(dy) <= known["b"] * moved + slack),
            "share_sign": _share(same) if L_y + L_u == 1 else jnp.full((), UNPROVED),
            "share_excited": excited,
            "share_kept": jnp.where(jnp.isnan(known["d2"]), jnp.nan, kept),
        }


def compact(scheme: Scheme) -> bool:
    """Whether a scheme is MFAILC with a window of one, of which d2 is proved."""
    return isinstance(scheme, FFDLMFAILC) and scheme.L_y + scheme.L_u == 1


# Over many machines
# ------------------------------------------------------------------------------

PREMISES = {
    "linear": "machine linear, without limit, rounding, noise or change",
    "alone": "y(k+1) depends on u(k) alone",
    "signs": "constant sign of phi, and of the estimate",
    "damped": "lam > b^2 / 4",
    "printed": "the law as printed: no lead, no limit",
    "share_lipschitz": "Lipschitz in the run: |Dy(k+1)| <= b |DH(k)|",
    "share_sign": "sign of phi in the run: that of the plant",
    "share_excited": "|DH| >= epsilon in the run, for d1",
}


class PremiseShare(NamedTuple):
    """A premise over S machines.

    name:         of the premise
    held:         number of machines on which it held throughout
    share_broken: mean share of samples and trials that broke it; of a premise on the plant or on
                  the law, the share of machines
    """

    name: str
    held: int
    share_broken: float


class Checked(NamedTuple):
    """The premises of the bounds over S machines, and the bounds beside what was observed.

    premises: those that the scheme has
    verdicts: on how many machines |e_j| <= d2 |e_(j-1)| is claimed and holds at every sample of
              every trial, is claimed and fails, and is not claimed
    care:     median over the machines with a claim of d2 / the largest ratio observed, which is 1
              where the bound is met exactly; None without a claim, or without an error to compare
    """

    premises: list[PremiseShare]
    verdicts: dict[str, int]
    care: float | None


def checked(found: Mapping[str, Leaf]) -> Checked:
    """The premises and the bounds of machines, from what a `BoundsWatch` found of them.

    found: (S,) and (S, J) by the names of the watch
    """
    shares = []
    for key, name in PREMISES.items():
        values = np.asarray(found[key], float)
        values = values[:, 1:] if values.ndim == 2 else values[:, None]
        if not np.all(np.isnan(values)):
            held, broken = int(np.sum(np.all(values == 1.0, axis=1))), 1.0 - np.nanmean(values)
            shares.append(PremiseShare(name, held, float(broken)))
    claimed = np.asarray(found["claimed"]) == 1.0
    holds = claimed & np.all(np.asarray(found["share_kept"])[:, 1:] == 1.0, axis=1)
    verdicts = {"holds": holds, "fails": claimed & ~holds, "not claimed": ~claimed}
    counts = {verdict: int(np.sum(of)) for verdict, of in verdicts.items()}
    ratios = np.asarray(found["contraction_worst"])[:, 1:]
    worst = np.max(np.where(np.isnan(ratios), 0.0, ratios), axis=1, initial=0.0)
    compared = claimed & (worst > 0)  # at rest, and after an error falls to 0, there is none
    care = np.asarray(found["d2"])[compared] / worst[compared]
    return Checked(shares, counts, float(np.median(care)) if len(care) else None)


def checked_machines(
    machine: Machine,
    scheme: Scheme,
    task: Task,
    trials: int,
    uncertainty: Uncertainty,
    drawn: Mapping[str, np.ndarray],
) -> Checked:
    """The premises and the bounds on each machine's run without noise.

    trials: J >= 2, as two trials are compared
    """
    run = tiled_with(_watched, trials=trials)
    return checked(run((scheme, task), drawn_machines(machine, uncertainty, drawn)))


def _watched(common, machine, *, trials):
    return learn(machine.noiseless(), *common, trials, watch=BoundsWatch()).watched


# How it is done
# ------------------------------------------------------------------------------


def _window(scheme: Scheme) -> tuple[int, int]:
    """L_y and L_u of the data model along the trials; 0 and 1 for a scheme that has none."""
    return (scheme.L_y, scheme.L_u) if isinstance(scheme, FFDLMFAILC) else (0, 1)


def _best(known, common):
    """The weights w that make w . h the best guess of a number.

    known: (L, L) covariance of h
    common: (L,) its covariance with the number
    """
    if not len(common):
        return common
    square = jnp.diagonal(known)
    size = jnp.sqrt(jnp.where(square > 0, square, 1.0))  # 1 where the window is empty, as at first
    ridge = RIDGE * jnp.finfo(known.dtype).eps * jnp.eye(len(common))
    return jnp.linalg.solve(known / jnp.outer(size, size) + ridge, common / size) / size


def _gains(ends, lam):
    """(2,) smallest and largest phi_hat / (lam + phi_hat^2) between two ends (2,)."""
    at_ends, turn = ends / (lam + ends**2), jnp.sqrt(lam)
    inside = lambda x: (ends[0] < x) & (x < ends[1])  # noqa: E731
    low = jnp.where(inside(-turn), -0.5 / turn, jnp.minimum(*at_ends))
    return jnp.stack([low, jnp.where(inside(turn), 0.5 / turn, jnp.maximum(*at_ends))])


def _linear(machine: Machine, task: Task) -> bool:
    """Whether the output of every trial is the same affine function of its input."""
    if machine.variation is not None:
        return False
    at = jnp.zeros((task.N, 1))
    return not noise_of(machine) and not obstacle(output_alone, (machine, task), at)


def _ranked(x, ranks):
    """(R,) the values of x >= 0 that so many values (R,) lie below, rounded down by 2^-11 at most.

    They are found bit by bit of the number, and counted by a product, which XLA vectorises: sorting
    a trial of 2000 samples takes ten times as long.
    """
    bits = lax.bitcast_convert_type(x.astype(jnp.float32), jnp.int32)
    ones = jnp.ones(len(x), jnp.float32)

    def turn(i, found):
        more = found + lax.shift_left(jnp.int32(1), jnp.int32(30) - i.astype(jnp.int32))
        below = (bits < more[:, None]).astype(jnp.float32) @ ones
        return jnp.where(below <= ranks, more, found)

    found = lax.fori_loop(0, TURNS, turn, jnp.zeros(len(ranks), jnp.int32))
    return lax.bitcast_convert_type(found, jnp.float32).astype(x.dtype)


def _share(held) -> jax.Array:
    """The share of samples that hold, exactly 1 where all do."""
    return 1.0 - jnp.sum(~held) / len(held)


def _earlier(signal, samples: int):
    """signal[k - samples], zero before the trial."""
    return signal if samples == 0 else jnp.pad(signal, (samples, 0))[:-samples]


def _first(leaf):
    return jnp.ravel(jnp.asarray(leaf))[0]


def _need_one_channel(task: Task) -> None:
    if task.inputs != 1 or task.outputs != 1:
        raise ValueError(
            f"bounds: the task has {task.inputs} inputs and {task.outputs} outputs; allowed is one "
            "of each"
        )
