"""The estimator of the pseudo gradient, which all model-free adaptive schemes share.

The pseudo gradient is that of the dynamic linearisation. Along the trial axis (Cao 2019) and along
the time axis (Dai 2014) the estimator is the same projection; only the increments differ.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

RESETS = ("book", "sign", "none", "smooth")


def pseudo_gradient(phi, dh, dy, *, eta, mu) -> list[jax.Array]:
    """One step of the pseudo-gradient estimator (Cao 2019, eq. 27).

        phi' = phi + eta dh / (mu + |dh|^2) (dy - phi . dh)

    For a window of one it is eq. 13 of Cao 2019 and eq. 11 of Dai 2014.

    phi: (...) each, L components of the estimate
    dh: (...) each, the L increments that these components multiply
    dy: (...) output increment that the increments dh caused
    eta: () step of the estimator
    mu: () > 0, with the unit of |dh|^2
    """
    miss = dy - sum(p * h for p, h in zip(phi, dh, strict=True))
    step = eta * miss / (mu + sum(h * h for h in dh))
    return [p + step * h for p, h in zip(phi, dh, strict=True)]


def reset_estimate(phi, du, phi0, *, component, epsilon, mode) -> list[jax.Array]:
    """Reset the estimate to its start value phi0 where it is not usable (Dai 2014, eq. 12).

    Cao 2019 prints no reset rule. The mode is one of

        book      reset where |phi_c| <= epsilon, |du| <= epsilon, or sign phi_c != sign phi0_c
        sign      the same without the condition on |du|, which can cause bursts
        none      never reset
        smooth    the conditions of `book`, blended over widths of epsilon, for tuning

    phi_c is the component of u(k). In `book` and `sign` the gradient is that of the branch taken:
    it is zero through an estimate that was reset, and it does not include the switching itself.
    `smooth` has the whole gradient. With s(z) = 1 / (1 + e^-z) it returns

        phi0 + w (phi - phi0),      w = s(phi_c sign(phi0_c) / epsilon - 1) s(|du| / epsilon - 1)

    The smaller epsilon is, the closer is `smooth` to `book`, and the steeper it is: its slope is
    at most |phi - phi0| / (4 epsilon). The forecasts of CFDL-MFAPC have no condition on |du|; with
    `smooth` they are reset as by `sign`.

    phi, phi0: (...) each, components of the estimate and of its start value
    du: (...) input increment [unit of u]
    component: index of phi_c
    epsilon: () reset threshold
    """
    if mode == "none":
        return phi
    along = phi[component] * jnp.sign(phi0[component])
    if mode == "smooth":
        w = jax.nn.sigmoid(along / epsilon - 1.0) * jax.nn.sigmoid(jnp.abs(du) / epsilon - 1.0)
        return [p0 + w * (p - p0) for p, p0 in zip(phi, phi0, strict=True)]
    useless = ~(along > epsilon)  # the conditions on size and sign in one; it is true for NaN
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
