"""What `certify` claims of the published laws in the long run, and the papers' own conditions.

Each law is asked on the nominal machine of its scenario. Most of these machines have friction,
hysteresis or limits, and most of these laws adapt, so that no theorem applies. The drive of MILC
2024 is asked once more as the linear machine that the paper's theory is about, without friction,
lead error and limits, along the first 500 samples: without and with its encoders, whose rounding
is bounded noise.
"""

import dataclasses

import output

import jaxilc
from jaxilc import theory
from jaxilc.theory.certificates import printed_conditions

jaxilc.setup()
folder = output.folder(__file__)
SAMPLES = 500  # what rounding adds is followed for up to 1024 inputs, and MILC has two
LAWS = {
    "cao-2019": ("cfdl-mfailc", "ffdl-mfailc", "ilc-mfapc"),
    "li-2020": ("p-type", "fixed-filter", "switchable"),
    "milc-2024": ("dilc", "milc"),
    "xu-2024": ("ilc-asmc",),
}


def cases():
    """The name of each machine, the machine, a scheme and a task."""
    for name, laws in LAWS.items():
        s = jaxilc.scenarios.load(name)
        for law in laws:
            yield name, law, s.machine, s.schemes[law], s.task
    s = jaxilc.scenarios.load("milc-2024")
    left_out = ("table_friction", "compensation", "lead_error", "force_limit", "encoder_step")
    linear = dataclasses.replace(s.machine.plant, **dict.fromkeys(left_out))
    task = dataclasses.replace(s.task, reference=s.task.reference[: SAMPLES + 1])
    for sensor in (None, s.machine.sensor):
        machine = jaxilc.Machine(linear, sensor=sensor)
        about = f"linear, {'with' if sensor else 'without'} encoders"
        for law, scheme in s.schemes.items():
            yield f"milc-2024, {about}", law, machine, scheme, task


rows = []
for name, law, machine, scheme, task in cases():
    found = theory.certify(machine, scheme, task, 2)
    row = {"machine": name, "law": law, "claim": str(found.claim[0])}
    row |= {"reason": str(found.reason[0])}
    printed = printed_conditions(scheme, task, machine)
    if law == "fixed-filter":  # the left side of eq. 9 with the filter of the error in it
        filtered = theory.frequency.learning_condition(machine, scheme, task)
        printed = {"Li 2020, eq. 9, filtered": filtered.condition}
    for place, one in printed.items() or (("", None),):
        rows.append(row | {"paper": place, "value": float(one.value) if one else float("nan")})
        print(rows[-1], flush=True)
output.write_rows(folder / "rows.csv", rows, shown=0)
