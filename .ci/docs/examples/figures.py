"""Figures: each function draws a result; the gallery has them in full."""

import numpy as np

import jaxilc
from jaxilc import (
    Machine,
    Sweep,
    Task,
    Tuning,
    Uniform,
    design,
    identification,
    outcomes,
    run_schemes,
    theory,
)
from jaxilc.figures import *
from jaxilc.filters import ZeroPhaseButterworth
from jaxilc.plants import ProcessModel, StateSpace, TwoAxes
from jaxilc.schemes import Filtered, PIDType
from jaxilc.theory import frequency, on_lines, q_filter
from jaxilc.tuning import pareto, worst_case_search
from jaxilc.tuning.objectives import Effort, Final
from jaxilc.uncertainty import draw

jaxilc.setup()
P = StateSpace([[0.8]], [[0.2]], [[1.0]], dt=1e-3)
machine, law = Machine(P), PIDType(gamma_p=1.0)
task = Task(np.sin(np.linspace(0, 2 * np.pi, 201)), dt=1e-3, unit="mm", input_unit="V")
gain = {"plant.B": Uniform(0.8, 1.2, relative=True)}
dataset, _ = run_schemes(machine, {"p": law}, task, trials=6)
swept = Sweep(machine, {"p": law}, task, 6, uncertainty=gain, machines=32).run()
um = {"scale": 1e3, "unit": "µm"}

# %% error_by_trial, save
axes = error_by_trial(dataset, **um)
print(save(axes, "errors.png"), save(axes, "errors.svg", dark=True))
# errors.png errors.svg

# %% error_band
axes = error_band(swept, tolerance=0.02, **um)

# %% tracking
axes = tracking(dataset, "p", (1, 2, 6), **um)

# %% spectrum, time_frequency
axes = spectrum(dataset, "p", (1, 6), **um)
axes = time_frequency(dataset, "p", (1, 6), window=0.064, **um)

# %% contour
t = np.linspace(0, 2 * np.pi, 201)
circle = Task(np.stack([np.cos(t) - 1, np.sin(t)], axis=1), dt=1e-3, unit="mm")
of_two, _ = run_schemes(Machine(TwoAxes(P, P)), {"p": law}, circle, trials=3)
axes = contour(of_two, "p", (1, 3), **um)

# %% certificate
found = theory.certify(machine, law, task, 10, gain, draw(machine, gain, 4))
axes = certificate(found, title="p", **um)

# %% frequency_tests
axes = frequency_tests({"p": frequency.learning_condition(machine, law, task)})

# %% grid_map
axis = {"p.gamma_p": "0.5:4:8"}
watch = theory.BoundsWatch()
over = Sweep(machine, {"p": law}, task, 6, gain, machines=8, grid=axis, watch=watch).run()
axes = grid_map(over, tolerance=0.02, **um)

# %% contraction_map, contraction_of
axes = contraction_map(over)
print(contraction_of(over).dims)
# ('scheme', 'p.gamma_p', 'sample')

# %% given_and_tuned, loss_by_step
few = {"machines": 4, "held_out": 4, "steps": 8}
problem = Tuning(machine, law, task, 6, ["gamma_p"], gain, objective=Final("rms"), **few)
tuned = problem.run()
axes = given_and_tuned(problem.compare(tuned, machines=8), metric="rms", **um)
axes = loss_by_step(tuned, name="rms of the last trial")

# %% final_error_by_trials
axes = final_error_by_trials(
    [5, 10], *np.geomspace(0.1, 0.001, 8).reshape(2, 2, 2), metric="rms", unit="mm"
)

# %% pareto_front
points = pareto(problem, Final("rms"), Effort(), shares=(0.2, 0.8))
axes = pareto_front(points, first="rms [mm]", second="effort [V]")


# %% worst_against_chance
def last(machine):
    """The rms error of the last trial."""
    return jaxilc.learn(machine, law, task, 6).rms[-1, 0]


searched = worst_case_search(last, machine, gain, starts=2, steps=8)
found = {"by gradient": searched.loss}
errors = swept.rms.values[0, :, -1].ravel()
axes = worst_against_chance(errors, found, nominal=float(last(machine)), metric="rms", unit="mm")

# %% record_figure, validation_figure
noise = np.random.default_rng(0).standard_normal((400, 1))
record = jaxilc.excite(Machine(ProcessModel(gain=2.0, poles=(60.0,))), noise, dt=1e-3)
identified = jaxilc.identify(record, poles=1, pairs=0, zeros=0, starts=8)
axes = record_figure(record, input_unit="V", output_unit="mm")
axes = validation_figure(record, identified, output_unit="mm")

# %% response_figure
axes = response_figure(identified, 1e-3, input_unit="V", output_unit="mm")

# %% potential_figure
e = np.sin(t) + 0.1 * np.random.default_rng(1).standard_normal((4, 201))
repeats = identification.Repeats(e, 1e-3, "mm", ("1", "2", "3", "4"))
axes = potential_figure(repeats, identification.potential_of(e, 1e-3))

# %% campaign_figure
rows = [
    {
        "trial": j,
        "event": "trial",
        "live": True,
        "rms_error": 0.5**j,
        "effort_u": 1.0,
        "source": "",
        "warnings": "",
    }
    for j in (1, 2, 3)
]  # as `Journal.log` tells them
axes = campaign_figure(rows, unit="mm", input_unit="V")

# %% COLOURS, DASHES, MARKS
print(len(COLOURS), len(DASHES), len(MARKS))  # one for each scheme, in order
# 7 7 7

# %% choose
choose("svg,dark")  # for all that is saved from now on
choose("png")

# %% q_filter_figure
filtered = Filtered(law, ZeroPhaseButterworth(100.0))
answered, _ = q_filter.question(machine, filtered, task, gain, machines=4)
axes = q_filter_figure({"p": answered.curves}, margin=0.1)

# %% response_fit_figure
lines = np.linspace(1.0, 200.0, 60)
first_order = 2.0 / (1 + 2j * np.pi * lines / 60)
measured = on_lines.MeasuredResponse(lines, first_order, np.full(60, 1e-3))
fitted = identification.identify_response(measured, poles=1, pairs=0, zeros=0, dt=1e-3, starts=8)
axes = response_fit_figure(measured, fitted, unit="mm/V")

# %% learned_law_figure (slow)
learned = design.LearnedLaw(machine, task, 6, gain, taps=(5, 3), machines=8, steps=2)
axes = learned_law_figure(learned.run("taps"), 1e-3, unit="V/mm")

# %% printed_and_ours, reproduction_figures (slow)
rows = outcomes.reproduce(["li-2020"]).numbers["rows"]
axes = printed_and_ours(rows, title="li-2020")
print(len(reproduction_figures(rows)))  # one for each paper
# 1
