"""What a command finds, in Python: `print` shows it as a terminal does, a notebook as a page."""

import textwrap
from pathlib import Path

import numpy as np

import jaxilc
from jaxilc import outcomes
from jaxilc.outcomes import Outcome, Reading, Request, Verdict

jaxilc.setup()
MACHINE = """
[plant]
kind = "transfer_function"
num = [4000.0]
den = [1.0, 80.0, 4000.0]
[task]
dt = 0.002
unit = "mm"
reference = { function = "sinusoid", amplitude = 1.0, frequency = 2.0, duration = 0.5 }
[schemes.ilc]
class = "Filtered"
scheme = { class = "PIDType", gamma_p = 0.8, lead = 8 }
filter = { class = "ZeroPhaseButterworth", cutoff = 50.0, order = 2 }
[uncertainty]
"plant.B" = { distribution = "uniform", low = 0.9, high = 1.1, relative = true }
"""  # a plant file, as `jaxilc init` writes one
small = Request("cao-2019", ("cfdl-mfailc",), trials=4)


def say(outcome):
    """The first sentence of the verdict."""
    print(textwrap.fill(outcome.verdict.said[0], 90))


# %% run, Request, Outcome, Verdict
ran = outcomes.run(Request("cao-2019", ("cfdl-mfailc",), trials=4))
print(isinstance(ran, Outcome), isinstance(ran.verdict, Verdict))
say(ran)
# True True
# cfdl-mfailc: trial 4 has a settled error of 519 µm, after 854 µm in trial 1; it is still
# falling.

# %% sweep
say(outcomes.sweep(small, machines=8))
# cfdl-mfailc: 0.0 % of 8 machines (95 % interval 0.0 % to 35.4 %) end within 5 µm; 95 % of
# them end with a settled error of at most 592 µm, the worst (machine 5) with 592 µm.

# %% certify (slow)
say(outcomes.certify(small, machines=2))
# cfdl-mfailc is not certified on 2 of 2 machines: CFDLMFAILC learns by a product of two
# signals.

# %% scenarios, settings
print(outcomes.scenarios().command, outcomes.settings("cao-2019").command)
# list list

# %% tune (slow)
tuned = outcomes.tune(small, weights="rho", unseen=8, machines=2, held_out=2, steps=2)
print(tuned.command, list(tuned.numbers)[:3])
# tune ['scenario', 'scheme', 'trials']

# %% pareto (slow)
print(
    outcomes.pareto(
        small,
        weights="rho",
        unseen=4,
        steps=1,
        machines=2,
        held_out=2,
        shares=(0.2, 0.8),
        objectives=("final", "effort"),
    ).command
)
# pareto

# %% worst_case (slow)
print(outcomes.worst_case(small, starts=2, steps=2, draws=4).command)
# worst-case

# %% filter_ (slow)
axis = Path("axis.toml")
axis.write_text(MACHINE)
say(outcomes.filter_("axis.toml", machines=4))
# ilc: safe for plant.B ±10 %: |Q (1 - L P)| is at most 0.837 (proved for all of them), a
# margin of 0.163; it is largest at 26.9 Hz on the machine plant.B x 0.9.

# %% filter_measured
lines = [f"{f},{(G := 1 / (1 + 1j * f / 10)).real:.9g},{G.imag:.9g}" for f in range(1, 499)]
Path("response.csv").write_text("frequency [Hz],re,im\n" + "\n".join(lines))
found = outcomes.filter_measured(["response.csv"], gain=0.5, cutoff=20.0, dt=1e-3)
say(found)
# Safe on every line: |Q (1 - L P)| is at most 0.726, a margin of 0.274; it is largest at 10
# Hz.

# %% design (slow)
say(outcomes.design("axis.toml", laws=("p-type",), machines=8, steps=2))
# Take p-type: P-type with lead and filter, gamma_p = 1.361, cutoff = 98.3 Hz, lead = 6
# samples.

# %% learn_law (slow)
learned = outcomes.learn_law("axis.toml", taps=(21, 11), trained_on=2, machines=8, steps=1)
print(learned.verdict.said[0].split(". ")[0])
# Safe, but not the best: u' = Q u + L e by learned filters, L of 21 taps and Q of 11

# %% init
say(outcomes.init("drive.toml", set_point=True))
# drive.toml runs as it is; put your own plant, task and uncertainty into it.

# %% identify_campaign
try:
    outcomes.identify_campaign(Path("no-campaign"), {"poles": 1})
except FileNotFoundError as error:  # it takes the folder of a campaign with measured trials
    print(error)
# no-campaign holds no campaign; `jaxilc next` without --measured starts one

# %% export, check_export (slow)
Path("axis.toml").write_text(MACHINE)
outcomes.export("axis.toml", folder="law", limit=2.0, machines=4).save()
print(outcomes.check_export("law").command)
# export

# %% demo (slow)
print(outcomes.demo().numbers["claims"])
# {'plain': 'diverges', 'tuned': 'monotone'}

# %% reproduce (slow)
say(outcomes.reproduce(["li-2020"]))
# Of 14 independent printed numbers 13 are met within 30 % or as bounds (7 within 10 %, 3
# within 3 %), 1 have the printed order, 0 are open. fitted: 6 of 6 met; predicted: 7 of 8
# met. 9 of 10 comparisons with the conclusions of papers hold.

# %% identify, Reading
rng = np.random.default_rng(0)
machine = jaxilc.Machine(jaxilc.plants.ProcessModel(gain=2.0, poles=(60.0,)))
record = jaxilc.excite(machine, rng.standard_normal((300, 1)), dt=1e-3)
jaxilc.write_record("record.csv", record)
reading = Reading(structure={"poles": 1, "pairs": 0, "zeros": 0})
say(outcomes.identify("record.csv", reading=reading))
# Order 1 fits 100 % of the output (100 % of the part that was not fitted).

# %% potential
t = 1e-3 * np.arange(501)
for number in range(3):
    e = np.sin(2 * np.pi * 4 * t) + 0.1 * rng.standard_normal(501)
    rows = "\n".join(f"{a:.3f},{b:.9g}" for a, b in zip(t, e, strict=True))
    Path(f"trial{number}.csv").write_text("t [s],e [mm]\n" + rows)
say(outcomes.potential([f"trial{i}.csv" for i in range(3)]))
# Learning can bring the error from 719 µm to 102 µm rms, a factor of 7.03, by what lies
# below 16 Hz; no law leaves less than what is new in each trial, 99.6 µm (95.4 µm to 104
# µm).
