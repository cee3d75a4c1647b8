"""Cao 2019, section II-B and Fig. 2 to 4: identification of the motor of eq. 7.

The motor is excited with an M-sequence and recorded, and eq. 6 is identified again.

The record has the encoder step of 0.1 µm, and noise of 0.1 µm. The structure is that of eq. 6, with
the double pole as a pair.
"""

import jax
import numpy as np
import output

import jaxilc
from jaxilc import Machine, Sensor, figures
from jaxilc.identification import excite, identify, write_record
from jaxilc.plants import voice_coil
from jaxilc.signals import references

jaxilc.setup()
folder = output.folder(__file__)
machine = Machine(voice_coil(), sensor=Sensor(resolution=1e-4, noise=1e-4))
u = references.m_sequence(10, amplitude=0.5, hold=5)
record = excite(machine, u, 1e-3, key=jax.random.key(2019))
write_record(folder / "record.csv", record)
found = identify(record)
# The values of eq. 7, in the form of eq. 6.
TRUE = {
    "gain": -7437.7769 * 928.2 / (474.0**2 * 6.404),
    "zeros[0]": 928.2,
    "poles[0]": 6.404,
    "frequencies[0]": 474.0,
    "dampings[0]": 1.0,
}
drawn = {
    "figures-2-3": figures.record_figure(record, input_unit="V", output_unit="mm"),
    "figure-4": figures.validation_figure(record, found, output_unit="mm", scale=1e3, unit="µm"),
}
for name, axes in drawn.items():
    figure = np.ravel(axes)[0].figure
    figure.suptitle("the record is simulated: eq. 7, noise and steps of 0.1 µm", fontsize="medium")
    figures.save(axes, folder / f"{name}.png")
repeats = [
    identify(excite(machine, u, 1e-3, key=jax.random.key(i)), found.plant) for i in range(20)
]
rows = []
for name, true in TRUE.items():
    value, low, high = found.parameters[name]
    caught = sum(r.parameters[name].low <= true <= r.parameters[name].high for r in repeats)
    rows.append(
        {
            "quantity": name,
            "identified": value,
            "low": low,
            "high": high,
            "true": true,
            "caught by 20 intervals of 95 %": caught,
        }
    )
output.write_rows(folder / "rows.csv", rows)
print(
    f"fit {found.fit[0]:.3f} %, on the validation part {found.validation_fit[0]:.3f} %; residual "
    f"white: {found.white}"
)
