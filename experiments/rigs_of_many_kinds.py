"""Ten drives of several kinds for campaigns through files; none shares code with the package.

Each is a function in plain NumPy that plays a set-point (N,) [mm] and returns the position that
its encoder measures, (N+1,) [mm]. Its position loop has a gain of 50 1/s. The arguments have the
values of a drive that is in order; a fault changes one of them.
"""

import numpy as np
from two_mass_rig import DT, Rig

LOOP, H = 50.0, DT / 5  # gain of the position loop [1/s]; step of the simulation [s]


def measured(positions, seed, noise=2e-4, step=1e-4):
    """The positions as an encoder tells them."""
    y = np.array(positions) + noise * np.random.default_rng(seed).standard_normal(len(positions))
    return step * np.round(y / step)


def simulated(u, seed, state, derivative, position=lambda state: state[0]):
    """Measured positions under dx/dt = derivative(x, s), by semi-implicit Euler steps."""
    x, positions = np.array(state, float), [0.0]
    for s in u:
        for _ in range(5):
            x = x + H * np.asarray(derivative(x, s))
        positions.append(position(x))
    return measured(positions, seed)


def two_mass_drive(u, seed, coulomb=3.0):
    """Two masses and a spring, friction, a loop around a loop."""
    return Rig(coulomb=coulomb).play(u, seed)


def voice_coil(u, seed, gain=1.0):
    """A moving coil with cogging; the gain is that of its set-point."""
    cogging = 200.0  # mm/s^2
    return simulated(
        u, seed, [0, 0],
        lambda x, s: (
            x[1], 400 * (LOOP * (gain * s - x[0]) - x[1]) - cogging * np.sin(np.pi / 4 * x[0])
        ),
    )  # fmt: skip


def ball_screw(u, seed, delay=1, play=0.02):
    """A nut with play on a screw that follows a late set-point."""
    late, table, motor, positions = np.append(np.zeros(delay), u)[: len(u)], 0.0, 0.0, [0.0]
    for s in late:
        motor += DT * LOOP * (s - motor)
        table = min(max(table, motor - play / 2), motor + play / 2)
        positions.append(table)
    return measured(positions, seed)


def belt(u, seed, resonance=25.0, damping=0.2):
    """A carriage on a soft belt, whose motor is controlled."""
    w = 2 * np.pi * resonance
    return simulated(
        u, seed, [0, 0, 0],
        lambda x, s: (
            x[1],
            w**2 * (x[2] - x[0]) + 2 * damping * w * (LOOP * (s - x[2]) - x[1]),
            LOOP * (s - x[2]),
        ),
    )  # fmt: skip


def cylinder(u, seed, pressure=1.0):
    """A hydraulic cylinder: a valve with a small dead band, and a flow that its supply limits."""
    fastest = 400 * np.sqrt(pressure)

    def derivative(x, s):
        wanted = LOOP * (s - x[0])
        wanted = np.sign(wanted) * max(abs(wanted) - 0.5, 0.0)
        return x[1], 300 * (np.clip(wanted, -fastest, fastest) - x[1])

    return simulated(u, seed, [0, 0], derivative)


def piezo(u, seed, counting=True):
    """A stage with hysteresis (Bouc and Wen); its encoder counts, or does not."""

    def derivative(x, s):
        rate = LOOP * (s - x[0])
        return rate, 0.2 * rate - 0.3 * abs(rate) * x[1]

    return counting * simulated(u, seed, [0, 0], derivative, lambda x: x[0] - 0.5 * x[1])


def long_pipe(u, seed, unit=1.0):
    """A first-order lag behind a dead time of 6 ms; the unit is that of the file."""
    late = np.append(np.zeros(6), u)[: len(u)]
    return unit * simulated(late, seed, [0], lambda x, s: (LOOP * (s - x[0]),))


def robot_joint(u, seed, payload=1.0):
    """A joint under gravity, whose payload slows it down."""
    return simulated(
        u, seed, [0, 0],
        lambda x, s: (
            x[1],
            (400 * (LOOP * (s - x[0]) - x[1]) - 300 * payload * np.sin(x[0] / 10)) / payload,
        ),
    )  # fmt: skip


def linear_motor(u, seed, ripple=2000.0):
    """A motor with force ripple, whose controller runs every fourth sample."""
    held = np.repeat(u[::4], 4)[: len(u)]
    return simulated(
        held, seed, [0, 0],
        lambda x, s: (
            x[1], 500 * (LOOP * (s - x[0]) - x[1]) + ripple * np.sin(2 * np.pi / 3.2 * x[0])
        ),
    )  # fmt: skip


def tool_servo(u, seed, lost=0.0):
    """A tool on a flexure; counts of its encoder may be lost in the middle [mm]."""
    w = 2 * LOOP
    y = simulated(u, seed, [0, 0], lambda x, s: (x[1], w**2 * (s - x[0]) - 2 * w * x[1]))
    return y - lost * (np.arange(len(y)) > len(y) // 3)


# Drive, the argument that a fault changes, and whether the machine stays so.
RIGS = {
    two_mass_drive: ({"coulomb": 60.0}, True),
    voice_coil: ({"gain": 0.7}, True),
    ball_screw: ({"delay": 9}, True),
    belt: ({"resonance": 12.0, "damping": 0.03}, True),
    cylinder: ({"pressure": 0.06}, True),
    robot_joint: ({"payload": 4.0}, True),
    linear_motor: ({"ripple": 12000.0}, True),
    piezo: ({"counting": False}, False),
    long_pipe: ({"unit": 1 / 25.4}, False),
    tool_servo: ({"lost": 3.0}, False),
}
