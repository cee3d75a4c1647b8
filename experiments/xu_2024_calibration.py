"""Xu 2024: a fit of the numbers that are not printed, to the PID, SMC and ASMC rows of Table 1.

Six free numbers are fitted to six printed ones. Then the learning gain is fitted to one number of
its row. The rest of this row and all of Table 2 are predicted.
"""

import jax.numpy as jnp
import numpy as np
import output
import scipy.optimize
from printed_tables import XU_1, XU_2

import jaxilc
from jaxilc.identification import fit
from jaxilc.scenarios.xu_2024 import READINGS, schemes_for, servo, settled_rms

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("xu-2024", reading="small-gain")
ROWS, OF = ("pid", "smc", "asmc"), READINGS["small-gain"]
# A k_n below 1000 fits a little better, but the loop then has no margin for 20 % more gain, which
# hysteresis alone may cause.
RANGES = {
    "A": (0.01, 0.15),
    "ki": (300.0, 1200.0),
    "eta": (1e5, 3e6),
    "k_n": (1e3, 5e3),
    "phi": (1e4, 1e6),
    "Delta": (500.0, 5e3),
}


def errors(A, scheme, trials=1, load=None):
    """The largest and the RMS error of the last trial [nm]."""
    machine = jaxilc.Machine(servo(A, load), s.machine.actuator, s.machine.sensor)
    history = jaxilc.learn(machine, scheme, s.task, trials, save=settled_rms)
    return 1e3 * jnp.stack([history.settled_error[-1, 0], history.saved[-1]])


def residuals(values):
    schemes = schemes_for(values)
    return jnp.concatenate(
        [jnp.log(errors(values["A"], schemes[name]) / jnp.array(XU_1[name])) for name in ROWS]
    )


best = fit(residuals, RANGES, starts=128, refine=6)
fitted = {name: float(f"{value:.4g}") for name, value in best.values.items()}
print("fitted, with costs of the best minima", np.round(best.refined, 4), fitted)


def too_much(share):
    """log(ours / printed) for the largest error of the tenth trial; positive for small gains."""
    found = float(
        errors(fitted["A"], schemes_for(fitted, OF._replace(share=share))["ilc-asmc"], 10)[0]
    )
    return np.log(found / XU_1["ilc-asmc"][0])


shares = np.arange(0.1, 3.0, 0.05)
levels = np.array([too_much(share) for share in shares])
first = int(np.argmax(levels < 0))
share = float(f"{scipy.optimize.brentq(too_much, shares[first - 1], shares[first], xtol=1e-4):.4g}")
print("share of the inverse learned in a trial:", share)

rows = []
for table, load, name in ((XU_1, None, "Table 1"), (XU_2, 1.0, "Table 2")):
    for scheme, printed in table.items():
        ours = np.asarray(
            errors(
                fitted["A"],
                schemes_for(fitted, OF._replace(share=share))[scheme],
                10 if scheme == "ilc-asmc" else 1,
                load,
            )
        )
        role = (
            "fitted"
            if load is None and scheme in ROWS
            else "predicted but for one number"
            if load is None
            else "predicted"
        )
        row = {"table": name, "scheme": scheme, "max published": printed[0], "max": float(ours[0])}
        rows.append(row | {"RMS published": printed[1], "RMS": float(ours[1]), "role": role})
output.write_rows(folder / "rows.csv", rows)
