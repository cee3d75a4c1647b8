"""Cao 2019, section IV-D: a search for the reading of ILC-MFAPC that meets its printed errors.

The paper prints the gains 0.2, 0 and 1, lam = 2 and P = 10. Open are:

    structure   the learned input is added to that of the feedback (parallel) or to the reference
                (series)
    gains       either sign, and the derivative gain per sample or per second
    lam         the paper's lam / P, or lam as printed

Each reading is simulated with 80 start values of the PPD, and the best one is shown.
"""

import itertools

import jax.numpy as jnp
import numpy as np
import output

import jaxilc
from jaxilc.schemes import CFDLMFAPC, OnReference, PIDType, WithFeedback

jaxilc.setup()
folder = output.folder(__file__)
s = jaxilc.scenarios.load("cao-2019", plant="printed")
PRINTED = {10: 8.0, 15: 1.5, 20: 0.3, 30: 0.3}
starts = -np.geomspace(1e-6, 0.3, 80)
rows, ax = [], output.axes()
readings = itertools.product((WithFeedback, OnReference), (-1.0, 1.0), (1.0, 1000.0), (20.0, 2.0))
for structure, sign, per_sample, lam in readings:

    def errors(machine, phi0, structure=structure, sign=sign, per_sample=per_sample, lam=lam):
        feedback = CFDLMFAPC(P=10, lam=lam, eta=0.9, mu=1.0, phi0=phi0)
        scheme = structure(PIDType(gamma_p=0.2 * sign, gamma_d=sign * per_sample), feedback)
        return s.shown_scale * jaxilc.learn(machine, scheme, s.task, 30).settled_error[:, 0]

    by_trial = np.asarray(jaxilc.tiled(errors)(s.machine, starts))
    misfit = np.abs(
        np.log(by_trial[:, np.array(list(PRINTED)) - 1] / np.array(list(PRINTED.values())))
    ).max(axis=1)
    best = int(np.argmin(jnp.nan_to_num(misfit, nan=np.inf, posinf=np.inf)))
    per = "per sample" if per_sample == 1 else "per second"
    name = f"{structure.__name__}, sign {sign:+g}, {per}, lam {lam:g}"
    found = {f"trial {j}": float(by_trial[best, j - 1]) for j in PRINTED}
    rows.append(
        {"reading": name, "phi0": float(starts[best]), "misfit": float(misfit[best])} | found
    )
    if misfit[best] < 3:
        ax.semilogy(np.arange(1, 31), by_trial[best], label=f"{name}, phi0 = {starts[best]:.2g}")
ax.plot(list(PRINTED), list(PRINTED.values()), "ko", mfc="none", label="published")
ax.set(xlabel="trial", ylabel="settled error [µm]")
ax.legend(fontsize="small")
ax.grid(True, which="both", alpha=0.25)
ax.figure.savefig(folder / "readings.png")
output.write_rows(folder / "rows.csv", sorted(rows, key=lambda row: row["misfit"]))
