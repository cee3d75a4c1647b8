"""The linear form of the voice-coil motor: matrices, poles, transfer function, third-order form."""

from __future__ import annotations

import numpy as np

from .linear import StateSpace
from .voice_coil import VoiceCoil


def third_order(motor) -> VoiceCoil | StateSpace:
    """See `VoiceCoilMotor.reduced`."""
    N, D = polynomials(motor)
    poles = np.roots(D)
    poles = poles[np.argsort(np.abs(poles), kind="stable")]
    slow, next_one = poles[:3], poles[3]
    if not np.isclose(slow.sum().imag, 0.0, atol=1e-9 * abs(next_one)):
        raise ValueError(
            "VoiceCoilMotor: no third-order form, since its third and fourth pole are a pair "
            f"{next_one:.4g}; "
            "current_gain or speed_gain must set them apart"
        )
    D_slow, D_fast = np.poly(slow).real, D[0] * np.poly(poles[3:]).real
    c_0 = N[-1] / D_fast[-1]
    c_1 = (N[-2] - c_0 * D_fast[-2]) / D_fast[-1]
    # rounding alone splits a double pole by 1e-8 of its size into a pair
    if np.all(np.abs(slow.imag) <= 1e-6 * np.abs(slow)) and np.all(slow.real < 0) and c_1 != 0:
        return VoiceCoil(gain=c_1, zero=-c_0 / c_1, poles=-slow.real[::-1])
    return StateSpace(
        np.vstack([np.eye(2, 3, 1), -D_slow[:0:-1]]),
        np.eye(3)[:, 2:],
        np.array([[c_0, c_1, 0.0]]),
    )


def matrices(xp, motor, d, k):
    """A (..., n, n), B (..., n), C (n,) of the linear motor with damping d and stiffness k.

    xp: NumPy or jax.numpy, which computes them
    """
    m, R, L, k_f, K_c = (
        motor.mass,
        motor.resistance,
        motor.inductance,
        motor.force_constant,
        motor.current_gain,
    )
    K_p, K_i, b, S, k_h = (
        motor.speed_gain,
        motor.speed_integral_gain,
        motor.setpoint_weight,
        motor.command_scale,
        motor.holding_gain,
    )
    delayed = motor.command_delay is not None
    # the Padé form has a feedthrough: w = 2 z - u
    of_z, of_u, lag = (2.0, -1.0, 2 / motor.command_delay) if delayed else (0.0, 1.0, 0.0)
    A = [
        [0.0, 1.0, 0.0, 0.0, 0.0],
        [-k / m, -d / m, k_f / m, 0.0, 0.0],
        [
            -K_c * b * K_p * k_h / L,
            -(K_c * K_p + k_f) / L,
            -(R + K_c) / L,
            K_c / L,
            K_c * b * K_p * S * of_z / L,
        ],
        [-K_i * k_h, -K_i, 0.0, 0.0, K_i * S * of_z],
        [0.0, 0.0, 0.0, 0.0, -lag],
    ]
    B = [0.0, 0.0, K_c * b * K_p * S * of_u / L, K_i * S * of_u, lag]
    n = 5 if delayed else 4
    entries = xp.broadcast_arrays(
        *(xp.asarray(a) for row in A[:n] for a in row[:n]), *(xp.asarray(a) for a in B[:n])
    )
    entries = xp.stack(entries, -1)
    shape = entries.shape[:-1]
    return (
        entries[..., : n * n].reshape(*shape, n, n),
        entries[..., n * n :],
        xp.asarray([1e3] + [0.0] * (n - 1)),
    )


def fastest_pole(motor) -> float:
    """Largest |pole| [rad/s], over all elements of batched leaves.

    It is looked for in free motion, and where friction, cogging and buffer are stiffest.
    """
    d, k = motor.viscous_damping, 0.0 if motor.stiffness is None else motor.stiffness
    stiff_d, stiff_k = d, k
    if motor.friction is not None:
        stiff_d = d + motor.friction.damping_at_rest
    if motor.cogging is not None:
        stiff_k = stiff_k + 2 * np.pi * motor.cogging.amplitude / motor.cogging.pitch
    if motor.end_effect is not None and motor.end_effect.buffer_stiffness is not None:
        stiff_k = stiff_k + motor.end_effect.buffer_stiffness
    cases = (matrices(np, motor, d, k)[0], matrices(np, motor, stiff_d, stiff_k)[0])
    return max(float(np.max(np.abs(np.linalg.eigvals(A)))) for A in cases)


def polynomials(motor):
    """N (high order first) and D of the full-order transfer function [mm/V], in closed form.

        N = 1000 S k_f K_c (b K_p s + K_i) (2/T - s)
        D = [s (L s + R + K_c)(m s^2 + d s + k) + k_f^2 s^2
             + k_f K_c (K_p s^2 + (K_i + b K_p k_h) s + K_i k_h)] (2/T + s)

    The last factors are absent where there is no delay.
    """
    names = (
        "mass",
        "resistance",
        "inductance",
        "force_constant",
        "viscous_damping",
        "current_gain",
        "speed_gain",
    )
    m, R, L, k_f, d, K_c, K_p = (float(getattr(motor, name)) for name in names)
    names = ("speed_integral_gain", "setpoint_weight", "command_scale", "holding_gain")
    K_i, b, S, k_h = (float(getattr(motor, name)) for name in names)
    k = 0.0 if motor.stiffness is None else float(motor.stiffness)
    N = 1e3 * S * k_f * K_c * np.array([b * K_p, K_i])
    D = np.polymul([L, R + K_c, 0.0], [m, d, k])
    D[2:] += np.array(
        [k_f**2 + k_f * K_c * K_p, k_f * K_c * (K_i + b * K_p * k_h), k_f * K_c * K_i * k_h]
    )
    if motor.command_delay is not None:
        lag = 2 / float(motor.command_delay)
        N, D = np.polymul(N, [-1.0, lag]), np.polymul(D, [1.0, lag])
    return N, D
