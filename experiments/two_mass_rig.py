"""A simulated feed drive for campaigns through files, whose code shares nothing with the package.

Two masses are coupled by a spring. The motor follows a set-point by a position loop around a
velocity loop; Coulomb and viscous friction act on both masses. The set-point arrives late, the
force is limited, and an encoder with noise and a grid measures the load. Everything is plain
NumPy: semi-implicit Euler steps, five in each sample. Play of the coupling and what differs from
trial to trial are zero unless a rig has them.
"""

import dataclasses

import numpy as np

DT, SUBSTEPS = 1e-3, 5


@dataclasses.dataclass(frozen=True)
class Rig:
    """A drive; every number may be replaced for a fault.

    motor, load: masses [kg]
    resonance: frequency of the load against the motor [Hz];  damping: its damping ratio
    position_gain: gain of the position loop [1/s]
    velocity_gain: gain of the velocity loop [N s/mm];  integral: of its integral part [1/s]
    coulomb: friction of the load [N];  viscous: of both masses [N s/mm]
    gain: of the set-point, 1 for a drive that is in order
    delay: of the set-point [samples]
    force: largest force of the motor [N]
    step: grid of the encoder [mm];  noise: standard deviation [mm]
    play_of_coupling: [mm]
    spread: standard deviation of the gain from trial to trial
    warming: share by which the gain grows with each trial
    push: standard deviation of a constant force on the load, another one in each trial [N]
    ripple: force on the load that repeats every 4 mm [N]
    wander: standard deviation of the steps of a random walk of the encoder [mm]
    spikes: standard deviation of the error of 0.3 % of the samples [mm]
    """

    motor: float = 2.0
    load: float = 1.0
    resonance: float = 60.0
    damping: float = 0.03
    position_gain: float = 50.0
    velocity_gain: float = 0.8
    integral: float = 20.0
    coulomb: float = 3.0
    viscous: float = 0.005
    gain: float = 1.0
    delay: int = 1
    force: float = 2000.0
    step: float = 1e-4
    noise: float = 2e-4
    play_of_coupling: float = 0.0
    spread: float = 0.0
    warming: float = 0.0
    push: float = 0.0
    ripple: float = 0.0
    wander: float = 0.0
    spikes: float = 0.0

    def play(self, setpoint, seed: int, trial: int = 1):
        """(N+1,) the measured position of the load [mm] under a set-point (N,) [mm]."""
        other = np.random.default_rng([seed, 1])  # what differs from trial to trial
        gain = self.gain * (1 + self.warming * (trial - 1))
        gain *= 1 + self.spread * other.standard_normal()
        push = self.push * other.standard_normal()
        h, kg = DT / SUBSTEPS, 1e-3  # N / kg is m/s^2; masses in t give mm/s^2
        m1, m2 = self.motor * kg, self.load * kg
        omega = 2 * np.pi * self.resonance
        reduced = m1 * m2 / (m1 + m2)
        k, c = reduced * omega**2, 2 * self.damping * reduced * omega
        late = np.concatenate([np.zeros(self.delay), np.asarray(setpoint, float)])
        x1 = x2 = v1 = v2 = integral = 0.0
        positions = [0.0]
        for s in gain * late[: len(setpoint)]:
            for _ in range(SUBSTEPS):
                off = self.position_gain * (s - x1) - v1
                pushed = self.velocity_gain * (off + integral)
                force = min(max(pushed, -self.force), self.force)
                if force == pushed:  # the integrator stops at the limit
                    integral += self.integral * off * h
                half = self.play_of_coupling / 2
                wound = x1 - x2 - min(max(x1 - x2, -half), half)
                spring = k * wound + (c * (v1 - v2) if wound or not half else 0.0)
                stick = self.coulomb * np.tanh(v2 / 0.5) + push
                stick += self.ripple * np.sin(np.pi / 2 * x2)
                v1 += h / m1 * (force - spring - self.viscous * v1)
                v2 += h / m2 * (spring - stick - self.viscous * v2)
                x1, x2 = x1 + h * v1, x2 + h * v2
            positions.append(x2)
        measured = np.array(positions)
        measured += self.noise * np.random.default_rng(seed).standard_normal(len(measured))
        n = len(measured)
        measured += self.wander * np.cumsum(other.standard_normal(n))
        measured += self.spikes * (other.random(n) < 3e-3) * other.standard_normal(n)
        return self.step * np.round(measured / self.step)


def stroke(length: float = 20.0, duration: float = 0.6):
    """(N+1,) there and back: two moves of a minimum-jerk polynomial, with a dwell after each."""
    N = round(duration / DT)
    move = N * 2 // 5
    s = np.linspace(0, 1, move)
    there = length * (10 * s**3 - 15 * s**4 + 6 * s**5)
    r = np.full(N + 1, length)
    r[:move], rest = there, N + 1 - N // 2
    r[N // 2 :] = np.concatenate([there[::-1], np.zeros(rest)])[:rest]
    return r


def write_trial(path, r, y, u):
    """Write a trial with 9 digits, as a machine's trace."""
    rows = [
        f"{k * DT:.9g},{r[k]:.9g},{y[k]:.9g},{f'{u[k]:.9g}' if k < len(u) else ''}"
        for k in range(len(y))
    ]
    path.write_text("t [s],r [mm],y [mm],u [mm]\n" + "\n".join(rows) + "\n")


def read_schedule(path):
    """(N,) the last column of a file of the next input, without the row after the end."""
    return np.genfromtxt(path, delimiter=",", skip_header=1)[:-1, -1]
