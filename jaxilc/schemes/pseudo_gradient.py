"""The estimator that all model-free adaptive schemes share: the pseudo gradient of the dynamic
linearisation.

Along the trial axis (Cao 2019) and along the time axis (Dai 2014) it is the same projection; what
differs is what an increment is.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

RESETS = ("book", "sign", "none", "smooth")


def pseudo_gradient(phi, dh, dy, *, eta, mu) -> list[jax.Array]:
    """One step of the pseudo-gradient estimator (Cao 2019, eq. 27; eq. 13 and Dai 2014, eq. 11 for
    a window of one).

        phi' = phi + eta dh / (mu + |dh|^2) (dy - phi . dh)

    phi, dh: L arrays of one shape, the estimate and the increments it multiplies;  dy: the output
    increment they brought about
    """
    miss = dy - sum(p * h for p, h in zip(phi, dh, strict=True))
    step = eta * miss / (mu + sum(h * h for h in dh))
    return [p + step * h for p, h in zip(phi, dh, strict=True)]


def reset_estimate(phi, du, phi0, *, component, epsilon, mode) -> list[jax.Array]:
    """Put the estimate back to its start value phi0 where it is of no use (Dai 2014, eq. 12; Cao
    2019 prints none).

    `book`: where |phi| <= epsilon, |du| <= epsilon, or sign phi != sign phi0 (phi: the component of
    u(k)); `sign`: the same without the |du| clause, which can cause bursts;  `none`: never
    The gradient is that of the branch taken: zero through a reset estimate, and blind to the
    switching itself. `smooth`: for tuning, the clauses of `book` blended over widths of epsilon,
    with the whole gradient and s(z) = 1 / (1 + e^-z):

        phi0 + w (phi - phi0),      w = s(phi_c sign(phi0_c) / epsilon - 1) s(|du| / epsilon - 1)

    The narrower, the nearer to `book` and the steeper: a slope of up to |phi - phi0| / (4 epsilon).
    Forecasts of CFDL-MFAPC, which have no |du| clause, are still reset as by `sign`.
    """
    if mode == "none":
        return phi
    along = phi[component] * jnp.sign(phi0[component])
    if mode == "smooth":
        w = jax.nn.sigmoid(along / epsilon - 1.0) * jax.nn.sigmoid(jnp.abs(du) / epsilon - 1.0)
        return [p0 + w * (p - p0) for p, p0 in zip(phi, phi0, strict=True)]
    useless = ~(along > epsilon)  # both clauses in one; true of NaN
    if mode == "book":
        useless = useless | (jnp.abs(du) <= epsilon)
    return [jnp.where(useless, p0, p) for p, p0 in zip(phi, phi0, strict=True)]


def need_window(scheme) -> None:
    """Raises ValueError unless phi0 and rho of a scheme fit its windows L_y and L_u."""
    window = scheme.L_y + scheme.L_u
    name, phi0, rho = type(scheme).__name__, scheme.phi0.shape, scheme.rho.shape
    if phi0 != (window,) and (phi0, window) != ((), 1):
        raise ValueError(
            f"{name}: phi0 has shape {phi0}; L_y = {scheme.L_y} and L_u = {scheme.L_u} need "
            f"({window},)"
        )
    if rho not in ((), (window,)):
        raise ValueError(f"{name}: rho has shape {rho}; allowed are () and ({window},)")
