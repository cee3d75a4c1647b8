"""What moves when a weight is moved: errors by trial, tracking and |Q - L P|, within a blink.

All weights, all machines and the spread are arguments of one compiled program; only a change of
what is static, such as a lead, compiles another, which is kept.
"""

from __future__ import annotations

import functools
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..learning.metrics import Keep
from ..learning.over_trials import check, learn
from ..pytree.named_paths import interval_at, kind_at, replaced, settable
from ..pytree.ranges import require
from ..runtime.tiles import tiled
from ..theory.law import traced_response
from ..theory.loop import linear_loop, response
from ..uncertainty import draw, drawn_machines, with_spread

if TYPE_CHECKING:
    from ..scenarios import Scenario
    from ..schemes import Scheme

MACHINES = 32  # the nominal one included
AT_MOST = 4096  # machines that follow a slider
MOST = 10  # sliders
DECADES = 2.0  # of a weight, to both sides of its value
LEADS, MORE = 60, 8  # least end of the slider of a lead [samples], and of another whole number
LINES = 240  # frequencies
KEPT = 8  # spreads whose machines are kept


class Control(NamedTuple):
    """A number that can be moved.

    path: of the scheme
    value: as given
    low, high: ends of the slider
    log: whether the slider is logarithmic
    whole: whether it is a whole number, whose change compiles another program
    """

    path: str
    value: float
    low: float
    high: float
    log: bool
    whole: bool


class Outcome(NamedTuple):
    """What the weights lead to.

    errors: (S, J) metric by trial of each machine, the nominal one first [shown unit]; inf where
        a machine diverged
    r, y, e, u: (N+1,) or (N,) signals of the last trial of the nominal machine; the first channel
    f, size: (F,) frequencies [Hz] and |Q - L P| of the nominal machine; empty where there is none
    """

    errors: np.ndarray
    r: np.ndarray
    y: np.ndarray
    e: np.ndarray
    u: np.ndarray
    f: np.ndarray
    size: np.ndarray


class Exploration:
    """A scheme of a scenario, whose weights are moved by hand.

    scenario: what is simulated
    scheme: its name; None for the first one that learns
    machines: number of machines, the nominal one included
    source: name or file of the scenario, for the command line
    Raises ValueError for a scheme that is not there, for more than 4096 machines, and as `learn`.
    """

    def __init__(
        self,
        scenario: Scenario,
        scheme: str | None = None,
        *,
        machines: int = MACHINES,
        source: str | None = None,
    ):
        require("explore", "machines", machines, f"[1, {AT_MOST}]", whole=True)
        learning = [name for name, one in scenario.schemes.items() if one.learns]
        name = scheme or next(iter(learning or scenario.schemes))
        self.scenario, self.source = scenario.select((name,)), source or scenario.name
        self.name, self.given = name, self.scenario.schemes[name]
        check(scenario.machine, self.given, scenario.task)
        self.machines = machines
        self.spread = _spread_of(scenario)
        self.controls = controls_of(self.given, float(scenario.task.dt))
        needed = {n: of for n, of in scenario.functions.items() if n == scenario.judged_by}
        self.keep = Keep.of(needed)
        dt, N = float(scenario.task.dt), scenario.task.N
        self.f = np.geomspace(1 / (N * dt), 0.5 / dt, LINES)
        self._machines: dict[float | None, Any] = {}

    def scheme_with(self, values: Mapping[str, float]) -> Scheme:
        """The scheme with values by path; raises ValueError naming what is allowed."""
        known = {control.path: control for control in self.controls}
        return replaced(
            self.given,
            {p: int(v) if known[p].whole else float(v) for p, v in values.items()},
        )

    def outcome(
        self, values: Mapping[str, float], spread: float | None = None, *, alone: bool = False
    ) -> Outcome:
        """What values by path lead to; a spread in place of that of the scenario.

        alone: the nominal machine alone, which takes a small part of the time
        Raises ValueError naming what is allowed.
        """
        s = self.scenario
        scheme = self.scheme_with(values)
        machines = self._drawn(self.spread if spread is None else float(spread))
        if alone:
            machines = jax.tree.map(lambda x: x[:1], machines)
        errors, signals, size = _computed(
            scheme, machines, s.machine, s.task, self.f,
            trials=s.trials, metric=s.judged_by, keep=self.keep, frequency=self._has_response(),
        )  # fmt: skip
        scale = s.shown(s.judged_by)[0]
        y, u = (np.asarray(x).reshape(len(x), -1)[:, 0] for x in signals)
        r = np.asarray(s.task.reference).reshape(len(y), -1)[:, 0]
        errors = scale * np.asarray(errors)
        found = np.asarray(size)
        return Outcome(errors, r, y, s.shown_scale * (r - y), u, self.f[: len(found)], found)

    def _drawn(self, spread: float | None) -> Any:
        """The machines of a spread; those of the last few spreads are kept."""
        s = self.scenario
        if spread not in self._machines:
            same = spread is None or spread == self.spread
            wide = s.uncertainty if same else with_spread(s.uncertainty, spread)
            drawn = draw(s.machine, wide, self.machines, sampling="sobol") if wide else {}
            if len(self._machines) >= KEPT:
                self._machines.clear()
            self._machines[spread] = drawn_machines(s.machine, wide, drawn)
        return self._machines[spread]

    @functools.cache  # noqa: B019  (an exploration lives as long as its page)
    def _has_response(self) -> bool:
        """Whether the law has a frequency response, on a machine of one output and one input."""
        s = self.scenario
        if not (s.task.inputs == s.task.outputs == 1 and self.given.learns):
            return False
        try:
            jax.eval_shape(
                lambda one: _size(one, s.machine, s.task, jnp.asarray(self.f)), self.given
            )
        except (ValueError, TypeError, NotImplementedError):
            return False
        return True

    def changed(self, values: Mapping[str, float]) -> dict[str, float]:
        """The values that differ from those given."""
        given = {control.path: control.value for control in self.controls}
        return {
            path: value
            for path, value in values.items()
            if not math.isclose(value, given[path], rel_tol=1e-9)
        }

    def command(self, values: Mapping[str, float], spread: float | None = None) -> str:
        """The command line that simulates the same on one machine, or on many with a spread."""
        words = ["jaxilc", "run" if spread is None else "sweep", self.source, "--scheme", self.name]
        for path, value in self.changed(values).items():
            words += ["--set", f"{self.name}.{path}={value:.6g}"]
        if spread is not None:
            words += ["--spread", f"{spread:.4g}"]
        return shlex.join(words)

    def save(self, values: Mapping[str, float], path: str | Path) -> Path:
        """Write the values as a parameter file, for `--params`."""
        from ..scenarios.parameters import differing, write_parameters

        Path(path).parent.mkdir(parents=True, exist_ok=True)
        changed = {self.name: differing(self.scheme_with(values), self.given)}
        how = {"command": "jaxilc explore", "options": dict(self.scenario.options)}
        return write_parameters(Path(path), self.scenario.name, changed, how)


def controls_of(scheme: Scheme, dt: float) -> list[Control]:
    """The single numbers of a scheme that can be moved, with the ends of their sliders.

    dt: sample time [s]; a cutoff stays below half of the sample rate
    """
    found = []
    for path, value in settable(scheme).items():
        kind = kind_at(scheme, path)[0]
        whole = kind == "static" and isinstance(value, int) and not isinstance(value, bool)
        if not (whole or kind == "leaf") or value is None or np.size(value) != 1:
            continue
        number, allowed = float(np.ravel(np.asarray(value))[0]), interval_at(scheme, path)
        if not np.isfinite(number):
            continue
        low, high = (-np.inf, np.inf) if allowed is None else (allowed.low, allowed.high)
        if whole:
            most = LEADS if path.endswith("lead") else MORE
            ends = (max(low, 0.0), min(high, max(most, 2 * number)))
        elif number > 0:
            ends = (max(low, number * 10**-DECADES), min(high, number * 10**DECADES))
        else:
            reach = max(4 * abs(number), 1.0)
            ends = (max(low, number - reach), min(high, number + reach))
        if path.rpartition(".")[2].startswith("cutoff"):
            ends = (ends[0], min(ends[1], 0.49 / dt))
        if ends[1] > ends[0]:
            log = not whole and ends[0] > 0 and ends[1] / ends[0] > 30
            found.append(Control(path, number, *ends, log, whole))
    return found[:MOST]


def _spread_of(scenario: Scenario) -> float | None:
    """The half-width of the first relative uniform uncertainty; None without one."""
    for one in scenario.uncertainty.values():
        if getattr(one, "relative", False) and hasattr(one, "high"):
            return float(np.max(np.asarray(one.high))) - 1.0
    return None


def _size(scheme, machine, task, f) -> jax.Array:
    """(F,) |Q - L P| of a machine."""
    law = traced_response(scheme, task, f)
    P = response(linear_loop(machine, scheme, task), f, task.dt)
    return jnp.abs(law.keep[:, 0, 0] - law.L[:, 0, 0] * P[:, 0, 0])


@functools.partial(jax.jit, static_argnames=("trials", "metric", "keep", "frequency"))
def _computed(scheme, machines, nominal, task, f, *, trials, metric, keep, frequency):
    """The errors of all machines, y and u of the last trial of the nominal one, and |Q - L P|."""

    def of(common, machine):
        scheme, task = common
        history = learn(machine, scheme, task, trials, save=keep)
        values = history.saved[metric] if keep.quantities else getattr(history, metric)
        values = jnp.max(values.reshape(trials, -1), axis=1)
        return jnp.where(history.diverged, jnp.inf, values), (history.final.y, history.final.u)

    errors, signals = tiled(of)((scheme, task), machines)
    first = jax.tree.map(lambda x: x[0], signals)
    return errors, first, _size(scheme, nominal, task, f) if frequency else jnp.zeros(0)
