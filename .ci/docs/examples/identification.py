"""Plants, friction and repeatable errors from records."""

import warnings
from pathlib import Path

import numpy as np

import jaxilc
from jaxilc import Machine
from jaxilc.identification import *
from jaxilc.plants import ProcessModel

jaxilc.setup()
rng = np.random.default_rng(0)
noise = rng.standard_normal((400, 1))
machine = Machine(ProcessModel(gain=2.0, poles=(60.0,)))

# %% excite, Record
record = excite(machine, noise, dt=1e-3)
print(isinstance(record, Record), record.y.shape)
# True (401, 1)

# %% write_record, read_record
write_record("record.csv", record)
print(read_record("record.csv").dt)
# 0.001

# %% identify, Identified, Estimate, PoleEstimate
found = identify(record, poles=1, pairs=0, zeros=0, starts=8)
print(isinstance(found, Identified), f"gain {found.parameters['gain'].value:.2f}")
print(isinstance(found.parameters["gain"], Estimate), isinstance(found.poles[0], PoleEstimate))
# True gain 2.00
# True True

# %% not_significant
print(not_significant(found))
# []

# %% compare_orders, best_order, Order
orders = compare_orders(record, structures=((1, 0, 0), (0, 1, 0)), starts=8)
print(isinstance(best_order(orders), Order), best_order(orders).poles)
# True 1

# %% orders_and_delays
warnings.simplefilter("ignore", FutureWarning)  # it is now `grow`
print(orders_and_delays(record, longest=4, structures=((1, 0, 0),), starts=8)[0].delay)
# 0

# %% grow, Grown, Tried
grown = grow(record, order=1)
print(isinstance(grown, Grown), all(isinstance(one, Tried) for one in grown.tried))
# True True

# %% suspicions, Suspicion
print(all(isinstance(one, Suspicion) for one in suspicions(record, [found.plant])))
# True

# %% friction_of, FrictionModel
t = 1e-3 * np.arange(2001)
x = 0.05 * np.sin(2 * np.pi * t)
v, a = np.gradient(x, t), np.gradient(np.gradient(x, t), t)
friction = friction_of(3.0 * a + 2.0 * v + 1.5 * np.sign(v), x, 1e-3)
print(isinstance(friction, FrictionModel), f"mass {friction.mass.value:.1f}")
# True mass 3.0

# %% fit, Fit
line = fit(lambda of: of["slope"] * t - 3.0 * t, {"slope": (1.0, 10.0)}, starts=8, refine=1)
print(isinstance(line, Fit), f"{line.values['slope']:.2f}")
# True 3.00

# %% potential_of, Potential
again = np.sin(2 * np.pi * 3 * t) + 0.1 * rng.standard_normal((5, 2001))
potential = potential_of(again, 1e-3)
print(isinstance(potential, Potential), f"{potential.new.value:.2f} is new in each trial")
# True 0.10 is new in each trial

# %% read_repeats, Repeats
for number in (1, 2):
    rows = "\n".join(f"{i * 1e-3:.3f},{e:.9g}" for i, e in enumerate(again[number]))
    Path(f"trial{number}.csv").write_text("t [s],e [mm]\n" + rows)
repeats = read_repeats(["trial1.csv", "trial2.csv"])
print(isinstance(repeats, Repeats), repeats.e.shape)
# True (2, 2001)

# %% read_frequency_response
f = np.linspace(1, 200, 60)
G = 2.0 / (1 + 2j * np.pi * f / 60) + 1e-3 * rng.standard_normal((2, 60)).T @ [1, 1j]
lines = "\n".join(f"{a:.6f},{g.real:.9g},{g.imag:.9g},1.4e-3" for a, g in zip(f, G, strict=True))
Path("response.csv").write_text("frequency [Hz],re,im,std\n" + lines)
measured = read_frequency_response("response.csv")
print(len(measured.frequencies))
# 60

# %% identify_response
by_lines = identify_response(measured, poles=1, pairs=0, zeros=0, dt=1e-3, starts=8)
print(f"gain {by_lines.parameters['gain'].value:.2f}")
# gain 1.95

# %% compare_response_orders
tried = compare_response_orders(measured, structures=((1, 0, 0),), dt=1e-3, starts=8)
print(tried[0].poles)
# 1

# %% grow_response, identified_response
models, chosen = grow_response(measured, dt=1e-3, highest=3)
print(type(identified_response(measured, chosen, 1e-3, None)).__name__)
# Identified

# %% pitch_of, Pitch
place = np.linspace(0, 60, 600)
force = 3 * np.sin(2 * np.pi * place / 12.0) + 0.1 * rng.standard_normal(600)
found = pitch_of(place, force, least=5.0, most=20.0)
print(isinstance(found, Pitch), f"{found.pitch:.2f} mm, {found.amplitudes[0]:.1f} N")
# True 12.00 mm, 3.0 N
