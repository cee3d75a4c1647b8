"""The main figures by commit: a sweep, a gradient, a certificate, the start of the command line.

`make history` runs them once on this commit. The sweep and the gradient are those of Cao 2019, in
the small; each is compiled before it is timed.
"""

import os
import subprocess
import sys
from typing import Any

MACHINES, TRIALS = 64, 20
OF_HERE = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}  # asv takes it away


class Learning:
    """What learning takes on one machine and on many."""

    timeout = 600

    def setup(self) -> None:
        """Compile all programs."""
        import jax

        import jaxilc

        jaxilc.setup()
        self.s: Any = jaxilc.scenarios.load("cao-2019").select(("cfdl-mfailc",))
        s, law = self.s, self.s.schemes["cfdl-mfailc"]
        self.sweep = jaxilc.Sweep(
            s.machine, s.schemes, s.task, TRIALS, uncertainty=s.uncertainty, machines=MACHINES
        )

        def last(rho: float) -> Any:
            changed = jaxilc.pytree.replaced(law, {"rho": rho})
            return jaxilc.learn(s.machine, changed, s.task, TRIALS).rms[-1, 0]

        self.slope = jax.jit(jax.value_and_grad(last))
        self.time_sweep()
        self.time_gradient()

    def time_sweep(self) -> None:
        """64 machines, 20 trials of 2000 samples."""
        self.sweep.run()

    def time_gradient(self) -> None:
        """The error of trial 20 and its derivative with respect to a weight."""
        self.slope(1.0)[1].block_until_ready()


class Certifying:
    """What theory takes, compilation included, as a user waits for it."""

    timeout = 600

    def time_certify(self) -> None:
        """One machine of one state under P-type learning."""
        import numpy as np

        import jaxilc
        from jaxilc.plants import StateSpace
        from jaxilc.schemes import PIDType

        jaxilc.setup()
        machine = jaxilc.Machine(StateSpace([[0.9]], [[0.1]], [[1.0]], dt=1e-3))
        task = jaxilc.Task(np.sin(np.linspace(0, 2 * np.pi, 501)), dt=1e-3)
        jaxilc.theory.certify(machine, PIDType(gamma_p=1.0), task, 30)


class Starting:
    """What a person waits for a first word."""

    def time_help(self) -> None:
        """`jaxilc --help` in a process of its own."""
        program = [sys.executable, "-m", "jaxilc", "--help"]
        subprocess.run(program, check=True, capture_output=True, env=OF_HERE)

    def time_import(self) -> None:
        """`import jaxilc` in a process of its own."""
        subprocess.run([sys.executable, "-c", "import jaxilc"], check=True, env=OF_HERE)
