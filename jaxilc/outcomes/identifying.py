"""`identify`: a plant from a record, a measured frequency response, or the trials of a campaign."""

from __future__ import annotations

import contextlib
import itertools
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .. import figures, identification
from ..hardware.campaign import record_of
from ..identification import Grown, Identified, Order
from ..identification.estimation import (
    MUCH,
    feedback_seen,
    not_significant,
    of_reference,
    validated,
    with_noise,
)
from ..identification.grown_response import LineModel, criterion, identified_response
from ..identification.not_linear import friction_of, suspicions
from ..identification.not_linear import sentences as of_suspicions
from ..identification.record_files import RESAMPLED, STEP_TOLERANCE, RecordFile, read_record_file
from ..identification.records import Record
from ..identification.refitting import Refit, beyond_nyquist, held_out, process_model_of, refit
from ..identification.sentences import NOT_WHITE, on_lines, sentence
from ..identification.sentences import verdict as sentences_on
from ..plants import ModalModel, Plant, ProcessModel
from ..pytree.aliases import Value
from ..scenarios import Scenario
from ..scenarios.campaigns import Given, Opened, open_campaign
from ..scenarios.file_plant import is_response
from ..scenarios.identified_file import write_plant_file, write_refitted
from ..storage.columns import plain_unit
from ..theory.loop import stable
from ..theory.on_lines import MeasuredResponse
from ..theory.q_filter import question
from .outcome import Figure, Interactive, Numbers, Outcome, Progress, Table, Verdict, silent

if TYPE_CHECKING:
    from ..figures.paper import Drawing

ANY = "any"  # zeros, of a model that has as many as its poles allow
SIMPLE = 4  # order up to which a gain with real zeros and poles may explain a response as well
AS_GOOD = 6.0  # of the criterion, by which it may be larger
RIGID = 90.0  # fit of mass and friction to a force [%], from which on they are told
NOTHING = 1e-12  # of the interval of a quantity, below which it is shown as 0
CHOSEN = "*"  # the mark of the chosen row of a table
MOST_ORDERS = 12  # rows of a table of orders
REFERENCE = "r"  # column of the reference of a closed loop
UNKNOWN_REFERENCE = (
    "A loop was closed in this record: the input answers the noise of the output, so that the fit "
    "is biased where the noise is not white. Without bias: record the reference as a column r, too."
)
WITHIN_A_SAMPLE = (
    "The input and the output of a sample belong together, more than the plant tells. Either a "
    "loop was closed in this record, and the fit is biased: record the reference as a column r, "
    "too. Or each row holds the output at the end of its sample: write the outputs one row later, "
    "since here y[k+1] answers u[k]."
)
OTHER_RATE = (
    "The record's own sample time is {own:.6g} s. At another one the fit is biased where the input "
    "changes within a new sample or the output is read between its own, and no feedback is looked "
    "for. --dt {own:.6g} has neither."
)
OF_REFERENCE = (
    "A loop was closed in this record: the plant is fitted from its reference, the column r, so "
    "that the noise in the input adds little bias; the residual holds what the feedback did about "
    "it."
)
OF_NOISE = (
    "A loop was closed in this record: the plant is fitted together with an autoregression of its "
    "noise, whose own residual is the white one, so that the noise in the input adds no bias."
)
OF_WHITE = (
    "A loop was closed in this record; the noise in the input adds no bias, since it is white."
)
SECOND = "A record that was not fitted, and the output that the plant predicts."
NO_LAW = "No filtered P-type law was found that learns on the fitted plant: the file has no scheme."
NO_NOISE = (
    "The file states no noise: what is predicted from it leaves out the {left} that the fit left; "
    "remove the # before [machine.sensor] and before the noise below it to count that."
)
FEEDBACK_FIRST = (
    " The plant does not come to rest after a trial, so a feedback comes first. Add to {} that of "
    'the machine, as [schemes.loop] with class = "WithFeedback", feedback = {{ class = "PID", '
    'kp = KP, kd = KD }} and learning = {{ class = "PIDType", gamma_p = 1.0 }}; or record the '
    "axis with its position loop closed."
)
CAPTIONS = {
    "record": "The recorded experiment: what was put in, and what was measured.",
    "validation": "The measured and the simulated output, and their difference.",
    "response": "The frequency response of the plant that was found, with its 95 % band.",
}


def identify(
    record: str | Path,
    *,
    reading: Reading | Mapping[str, Value] | None = None,
    validate: Path | None = None,
    plant_file: Path | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """A plant from a recorded experiment or a measured frequency response, with its reliability.

    record: file of a record or of a frequency response, which its header tells
    reading: how it is read, and the structure to fit, also as a dictionary; a table chooses the
        structure if none is given
    validate: file of a second record in time, of the same columns, which judges
    plant_file: plant file to write, for all other commands
    folder: for the figures; out/identify if not given
    Raises ValueError naming what is allowed.
    """
    asked = reading if isinstance(reading, Reading) else Reading(**(reading or {}))
    record = Path(record)
    of_lines = is_response(record, asked.columns)
    if of_lines and plant_file is not None and asked.dt is None:
        raise ValueError(
            "--out FILE.toml of a frequency response needs --dt, the sample time of its hold"
        )
    progress("fitting")
    of = _of_response if of_lines else _of_record
    fitted, closed = _of_loop(record, asked, of(record, asked, progress))
    found = fitted.found
    lines, has_law = sentences_on(found, fitted.dt) + closed, True
    said, suspected, of_friction = _not_linear(fitted)
    lines += said
    figures_of = fitted.drawn()
    second: Numbers = {}
    if validate is not None:
        said, second, figures_of["second"] = _on_second(Path(validate), asked, fitted)
        lines += said
    if plant_file is not None:
        progress("a law for it")
        of_law, has_law = _plant_file(plant_file, fitted, str(record))
        lines.append(of_law)
        if not found.of_response:
            left = f"{float(found.residual_std[0]):.3g} {fitted.units[1]}".rstrip()
            lines.append(NO_NOISE.format(left=left))
    return Outcome(
        command="identify", numbers=numbers_of(found) | fitted.structure | suspected | second,
        verdict=Verdict(tuple(lines), *_next(record, asked, fitted, plant_file, has_law)),
        folder=Path(folder or "out/identify"),
        tables=[*fitted.tables, identification_table(str(record), found.summary()), *of_friction],
        lines=fitted.lines, figures=figures_of, kept=[plant_file] if plant_file is not None else [],
        live=fitted.live,
        asked=fitted.structure,
    )  # fmt: skip


def _of_loop(path: Path, asked: Reading, fitted: Fitted) -> tuple[Fitted, list[str]]:
    """The fit without the bias of a feedback, where one is seen and the reference is recorded."""
    record, found = fitted.measured, fitted.found
    if not isinstance(record, Record):
        return fitted, []
    if fitted.own is not None:
        return fitted, [OTHER_RATE.format(own=fitted.own)]
    y = np.reshape(record.y, (len(record.y), -1))
    one = y.shape[1] == np.ndim(np.atleast_1d(record.u[0])) == 1
    if not one or not feedback_seen(record, y - found.simulated):
        return fitted, []
    reference = None
    with contextlib.suppress(ValueError):
        reference = asked._replace(input=REFERENCE).of_record(path).record.u
    if reference is None and not feedback_seen(record, y - found.simulated, late=1):
        return fitted, [WITHIN_A_SAMPLE]
    again = with_noise(record, found)
    if again.white:
        return fitted._replace(found=again), [OF_WHITE if again is found else OF_NOISE]
    if reference is None:
        return fitted, [UNKNOWN_REFERENCE]
    found = identification.identify(of_reference(record, reference), found.plant)
    return fitted._replace(found=found), [OF_REFERENCE]


def _not_linear(fitted: Fitted) -> tuple[list[str], Numbers, list[Table]]:
    """What may not be linear in the machine of a record; numbers and tables."""
    record, found = fitted.measured, fitted.found
    if not isinstance(record, Record) or found.plant.n_u * found.plant.n_y > 1:
        return [], {}, []
    if fitted.grown is None:
        told, alone = suspicions(record, [found]), getattr(found.plant, "order", 0)
        rms = float(found.residual_std[0])
    else:
        told, best = fitted.grown.suspicions, min(fitted.grown.tried, key=lambda one: one.rms)
        alone, rms = best.order, best.rms
    lines = of_suspicions(told, rms, alone)
    numbers = {"suspicions": [one._asdict() for one in told]} if told else {}
    if found.white:  # a plant that is linear explains all, and a force would be one by chance
        return lines, numbers, []
    try:
        of = friction_of(record.u[:, 0], record.y[:-1, 0], record.dt)
    except ValueError:
        return lines, numbers, []
    if of.fit < RIGID or not of.coulomb.low > 0:  # no force that accelerates a mass with friction
        return lines, numbers, []
    rows = [(name, *value) for name, value in of._asdict().items() if name != "fit"]
    lines.append(
        f"The input is that of a mass with friction, to {of.fit:.4g} %: the table has its numbers. "
        "Their intervals hold if nothing else acts; a second motion tells how far they differ."
    )
    table = identification_table("mass and friction", rows)
    return lines, numbers | {"friction": {name: value for name, value, *_ in rows}}, [table]


def _on_second(path: Path, asked: Reading, fitted: Fitted) -> tuple[list[str], Numbers, Figure]:
    """What a second record says of the plant: sentences, numbers and a figure."""
    if fitted.dt is None or is_response(path, asked.columns):
        raise ValueError(
            f"--validate {path} must be a record in time; a plant of a response needs --dt for it"
        )
    read = asked.of_record(path)
    record, theirs = read.record, (read.input_units[0], read.output_units[0])
    for name, own_unit, unit in zip((asked.input, asked.output), fitted.units, theirs, strict=True):
        if own_unit and unit and plain_unit(own_unit) != plain_unit(unit):
            raise ValueError(
                f"--validate {path}: {name} is in {unit!r}, in the record that was fitted in "
                f"{own_unit!r}; allowed is one unit, and nothing is converted"
            )
    if abs(record.dt / fitted.dt - 1) > STEP_TOLERANCE:
        raise ValueError(
            f"--validate {path} has the sample time {record.dt:g} s, the plant was fitted with "
            f"{fitted.dt:g} s; --dt {fitted.dt:g} resamples both"
        )
    found, of = fitted.found, fitted.units[1]
    on = validated(record, found.plant)
    rms, own = float(np.max(on.rms)), float(np.max(found.residual_std))
    said = [
        f"On {path}, which was not fitted, it fits {float(np.min(on.fit)):.4g} % of the output, "
        f"with an rms error of {rms:.3g} {of}".rstrip()
        + "."
    ]
    if not found.of_response and rms > MUCH * own:
        said.append(
            f"That error is {rms / own:.3g} times the residual of the fit: the machine is not the "
            "same there, or not linear, such as by friction or another amplitude; fit a record "
            "like the motions that will be learned."
        )
    shown = found._replace(
        simulated=on.simulated, fit=on.fit, samples=len(record.y), of_response=False
    )
    draw = partial(figures.validation_figure, record, shown, output_unit=of, unit=of)
    numbers = {"file": str(path), "fit": on.fit.tolist(), "rms": on.rms.tolist()}
    return said, {"validate": numbers}, Figure(SECOND, draw)


def numbers_of(found: Identified) -> Numbers:
    """The quantities that were identified, with their 95 % intervals, and how sound they are."""
    quantities: Numbers = {
        name: {"value": value, "low": low, "high": high}
        for name, value, low, high in found.summary()
    }
    return quantities | {"white": bool(found.white), "converged": bool(found.converged)}


class Reading(NamedTuple):
    """How a file is read, and what is fitted to it.

    structure: poles, pairs and zeros; empty: grown from a record, chosen by a table for a response.
        With "any" for the zeros, as many are fitted, real or complex, as the poles allow
    delay: dead time in samples; None: chosen, or none
    dt: sample time [s]
    averages: number of averages of a coherence
    time, input, output, time_unit, columns, resample: as for `read_record_file`
    """

    structure: Mapping[str, int | str] = {}
    delay: int | None = None
    dt: float | None = None
    averages: int | None = None
    time: str = "t"
    input: str = "u"
    output: str = "y"
    time_unit: str | None = None
    columns: Sequence[str] = ()
    resample: float | None = None

    def of_record(self, path: Path) -> RecordFile:
        """A record, read as this says."""
        if self.input == self.output:
            raise ValueError(
                f"--input and --output are both {self.input!r}; allowed is one column of each"
            )
        return read_record_file(
            path, dt=self.dt, time=self.time, input=self.input, output=self.output,
            time_unit=self.time_unit, columns=self.columns, resample=self.resample,
        )  # fmt: skip

    def options(self) -> str:
        """The options on reading as they are typed, each after a blank."""
        usual = {"time": "t", "input": "u", "output": "y"}
        given = {name: getattr(self, name) for name in (*usual, "time_unit", "columns", "resample")}
        given = {name: of for name, of in given.items() if of and of != usual.get(name)}
        given |= {"columns": ",".join(self.columns)} if self.columns else {}
        given |= {"dt": self.dt, "averages": self.averages}
        return "".join(
            f" --{name.replace('_', '-')} {shlex.quote(format(of))}"
            for name, of in given.items()
            if of is not None
        )


class Fitted(NamedTuple):
    """What was found.

    structure: that was fitted, with the delay where it is whole;  dt: [s], None if not known
    tables: of the structures that were compared;  units: of input and output
    lines: sentences on how the file was read
    grown: what was grown, where the structure was looked for
    own: sample time of a record [s] that was resampled to another one
    """

    measured: Record | MeasuredResponse
    found: Identified
    dt: float | None
    structure: Numbers
    tables: list[Table]
    units: tuple[str, str] = ("", "")
    lines: tuple[str, ...] = ()
    grown: Grown | None = None
    own: float | None = None

    def drawn(self) -> dict[str, Figure]:
        """The figures of a record, its model and the Bode diagram, or of both responses."""
        measured, found, (into, of) = self.measured, self.found, self.units
        units = {"input_unit": into, "output_unit": of}
        draw: dict[str, partial[Drawing]] = {}
        if not isinstance(measured, Record):
            draw["response"] = partial(figures.response_fit_figure, measured, found)
        else:
            draw["record"] = partial(figures.record_figure, measured, **units)
            draw["validation"] = partial(
                figures.validation_figure, measured, found, unit=of, output_unit=of
            )
            if found.plant.n_u == found.plant.n_y == 1:
                draw["response"] = partial(figures.response_figure, found, measured.dt, **units)
        return {name: Figure(CAPTIONS[name], of_name, live=True) for name, of_name in draw.items()}

    def live(self) -> list[Interactive]:
        """The same as interactive figures, a record and its model in one."""
        drawn = self.drawn()
        if drawn.pop("record", None) is not None:
            both = partial(drawn["validation"].draw, input_unit=self.units[0])
            drawn["validation"] = drawn["validation"]._replace(draw=both)
        return [figure.described() for figure in drawn.values()]


def _plant_file(path: Path, fitted: Fitted, source: str) -> tuple[str, bool]:
    """Write the plant file; what its law was chosen for, and whether there is one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    law = write_plant_file(
        path, fitted.found, fitted.measured, dt=fitted.dt, source=source, units=fitted.units,
        force=True,
    )  # fmt: skip
    said = NO_LAW if law is None else f"{path}: {law.told}. `jaxilc run {path}` simulates it."
    return said + FEEDBACK_FIRST.format(path) * (not _rests(fitted)), law is not None


def _rests(fitted: Fitted) -> bool:
    """Whether the plant comes to rest after a trial, without which `design` takes no law."""
    poles = np.asarray(getattr(fitted.found.plant, "all_poles", ()))
    return bool(stable(np.max(np.abs(np.exp(poles * (fitted.dt or 0.0))), initial=0.0)))


def _next(
    record: Path, asked: Reading, fitted: Fitted, plant_file: Path | None, has_law: bool
) -> tuple[str, str]:
    """What to do next, in words, and the command."""
    if plant_file is not None:
        what = "a law that is tuned and judged" if has_law else "a law for it"
        what = what if _rests(fitted) else "with this feedback in the file, a law for it"
        return what, f"jaxilc design {shlex.quote(str(plant_file))}"
    found = fitted.found
    again = f"jaxilc identify {shlex.quote(str(record))}{asked.options()}"
    doubted = not (found.white and found.converged) or not_significant(found)
    if doubted and asked.structure:
        return "structures compared", f"{again} --auto"
    options = {"auto": ""} if "modes" in fitted.structure else fitted.structure
    chosen = " ".join(f"--{name} {value}".strip() for name, value in options.items())
    sampled = " --dt DT" if found.of_response and asked.dt is None else ""
    what = "a plant file for all other commands"
    return what, f"{again} {chosen}{sampled} --out {_unused('axis')}"


def _unused(name: str) -> str:
    """A plant file that is not there yet, such as axis-2.toml, as `--out` replaces none."""
    names = itertools.chain([name], (f"{name}-{i}" for i in itertools.count(2)))
    return next(f"{one}.toml" for one in names if not Path(f"{one}.toml").exists())


def _of_record(path: Path, asked: Reading, progress: Progress) -> Fitted:
    """The fit to a record, after the table of orders where the structure is to be chosen."""
    if asked.averages is not None:
        raise ValueError(f"--averages {asked.averages} is for a frequency response; {path} is none")
    read = asked.of_record(path)
    lines = () if read.resampled is None else (RESAMPLED.format(dt=read.resampled),)
    record, tables, grown = read.record, [], None
    structure: Numbers = dict(asked.structure)
    if not structure or structure["zeros"] == ANY:
        order = structure["poles"] + 2 * structure["pairs"] if structure else None
        grown = identification.grow(
            record, order=order, delay=asked.delay, each=lambda said: progress(f"fitting: {said}")
        )
        found, structure = grown.found, _grown_structure(grown)
        tables.append(grown_table(grown))
    else:
        found = identification.identify(record, **structure, delay=asked.delay or 0)
        structure |= {"delay": asked.delay} if asked.delay else {}
    units = read.input_units[0], read.output_units[0]
    return Fitted(record, found, record.dt, structure, tables, units, lines, grown, read.own)


def _grown_structure(grown: Grown) -> Numbers:
    """The options that fit the plant again: counts of a ProcessModel, else those of its parts."""
    plant, chosen = grown.found.plant, grown.chosen
    late = {"delay": chosen.delay} if chosen.delay else {}
    if isinstance(plant, ProcessModel):
        return _counts(plant) | late
    lags = chosen.lags + chosen.integrators
    return {"poles": lags, "pairs": chosen.modes, "zeros": ANY, **late}


def _counts(plant: ProcessModel) -> Numbers:
    return {"poles": len(plant.poles), "pairs": len(plant.frequencies), "zeros": len(plant.zeros)}


def _of_response(path: Path, asked: Reading, progress: Progress) -> Fitted:
    """The fit to a frequency response, after the table of orders as for a record."""
    for name in ("time_unit", "columns", "resample"):
        if getattr(asked, name):
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is for a record in time; {path} is a frequency response")
    if asked.delay is not None and asked.dt is None:
        raise ValueError(f"--delay {asked.delay} counts samples of a response: give --dt, too")
    if asked.structure.get("zeros") == ANY:
        raise ValueError("--zeros any is for a record in time; a response takes a number")
    measured = identification.read_frequency_response(path, averages=asked.averages)
    fixed = None if asked.delay is None else asked.delay * (asked.dt or 0.0)
    tables: list[Table] = []
    lines: tuple[str, ...] = ()
    structure: Numbers = dict(asked.structure)
    if structure:
        found = identification.identify_response(measured, **structure, dt=asked.dt, delay=fixed)
    else:
        found, structure, tables, lines = _grown_response(measured, asked.dt, fixed, progress)
    structure |= {} if asked.delay is None else {"delay": asked.delay}
    return Fitted(measured, found, asked.dt, structure, tables, lines=lines)


def _grown_response(
    measured: MeasuredResponse, dt: float | None, delay: float | None, progress: Progress
) -> tuple[Identified, Numbers, list[Table], tuple[str, ...]]:
    """The plant of the chosen order, or a gain with real zeros and poles that explains as much."""
    orders, chosen = identification.grow_response(
        measured, dt=dt, delay=delay, each=lambda order: progress(f"order {order}")
    )
    tables = [grown_response_table(orders, chosen)]
    if chosen.parts.order <= SIMPLE:
        # the search of a structure that the lines do not have may end at a damping of 0
        with contextlib.suppress(ValueError):
            compared = identification.compare_response_orders(measured, dt=dt, delay=delay)
            best = identification.best_order(compared)
            P = best.found.simulated[:, 0]
            if criterion(measured, chosen, P, best.parameters) <= chosen.bic + AS_GOOD:
                real: Numbers = {"poles": best.poles, "pairs": best.pairs, "zeros": best.zeros}
                return best.found, real, [orders_table(compared, best, dt)], ()
    found = identified_response(measured, chosen, dt, delay)
    structure = {"order": chosen.parts.order, **chosen.parts.counts}
    structure |= {"floor": chosen.floor, "median_error": chosen.median}
    structure |= {"within_10_percent": chosen.within[0], "within_30_percent": chosen.within[1]}
    structure |= {"unweighted_fit": chosen.fit, "share_of_noise": chosen.share_of_noise}
    return found, structure, tables, tuple(on_lines(orders, chosen, measured))


def identification_table(title: str, rows: Sequence[tuple[str, float, float, float]]) -> Table:
    """The table of identified quantities with their 95 % intervals."""
    rates = any(name.startswith("pole ") for name, *_ in rows)
    title += ": identified, with 95 % intervals" + "; zeros, poles, frequencies in rad/s" * rates
    table = Table("quantity", right=("value", "low", "high"), title=title)
    for name, *values in rows:
        largest = NOTHING * np.max(np.abs(values), where=np.isfinite(values), initial=0.0)
        shown = [0.0 if abs(v) < largest else v for v in values]
        table.add_row(name, *(f"{v:.6g}" if np.isfinite(v) else "–" for v in shown))
    return table


def grown_response_table(orders: Sequence[LineModel], chosen: LineModel) -> Table:
    """The table of the best model of each order of a response, of which the chosen one is marked.

    In % are the error that is the model's own, the median of the relative error, and the shares of
    lines within 10 and 30 %; held out is -2 log likelihood a line, above the chosen. The mark is
    in the first column, which every part of a folded table repeats.
    """
    counts = ("order", "lags", "modes", "integr.", "direct")
    errors = ("floor [%]", "median [%]", "<10 %", "<30 %", "fit [%]")
    title = (
        f"models by order; BIC above that of the chosen one, {CHOSEN} ({chosen.bic:.1f}); the fit "
        "here counts all lines alike, that of the chosen plant weighs each by its scatter"
    )
    table = Table(right=(*counts, *errors, "BIC", "held out"), title=title)
    for one in orders:
        of_error = (one.floor, one.median, *one.within, one.fit / 100)
        table.add_row(
            f"{CHOSEN} {one.parts.order}" if one is chosen else str(one.parts.order),
            *(str(int(count)) for count in one.parts.counts.values()),
            *(f"{100 * share:.3g}" for share in of_error),
            f"{one.bic - chosen.bic:+.1f}",
            f"{one.held_out - chosen.held_out:+.3f}",
        )
    return table


def grown_table(grown: Grown) -> Table:
    """The table of the fits that `grow` compared, of which the chosen one is marked."""
    shown, least = grown.tried, grown.chosen.bic
    if len(shown) > MOST_ORDERS:
        best = sorted(shown, key=lambda one: one.bic)[:MOST_ORDERS]
        shown = [one for one in shown if one in best or one == grown.chosen]
    optional = ("integrators", "direct", "delay")
    there = [name for name in optional if any(getattr(one, name) for one in shown)]
    count = f"{len(shown)} of {len(grown.tried)}" if len(shown) < len(grown.tried) else "models"
    columns = ("order", "lags", "modes", *there, "rms", "BIC", "valid. [%]")
    title = f"{count} by BIC, above that of the chosen one, {CHOSEN} ({least:.1f})"
    table = Table(right=columns, title=title)
    for one in shown:
        order = f"{CHOSEN} {one.order}" if one == grown.chosen else str(one.order)
        counts = (one.lags, one.modes, *(int(getattr(one, name)) for name in there))
        values = (f"{one.rms:.4g}", f"{one.bic - least:+.1f}", f"{one.validation_fit:.4g}")
        table.add_row(order, *map(str, counts), *values)
    return table


def orders_table(orders: Sequence[Order], best: Order, dt: float | None = None) -> Table:
    """The table of the structures that were compared, of which the best one is marked.

    rms is that of the residual in the unit of the output; of a frequency response, divided by the
    standard deviation of each line. A delay is in samples of dt, or else in ms.
    """
    of_response = best.found.of_response
    delayed = any(_delay(one.found.plant) > 0 for one in orders)
    title = f"structures by BIC, above the smallest ({best.bic:.1f})"
    delay = ("delay" if dt else "delay [ms]",) * delayed
    last = () if of_response else ("valid. [%]",)
    rms = "rms / std" if of_response else "rms"
    table = Table(right=("poles", "pairs", "zeros", *delay, rms, "BIC", *last, ""), title=title)
    for one in orders:
        counts = (one.poles, one.pairs, one.zeros)
        late = (f"{_delay(one.found.plant) / (dt or 1e-3):.4g}",) * delayed
        values = (f"{one.rms:.4g}", f"{one.bic - best.bic:+.1f}")
        share = () if of_response else (f"{one.validation_fit:.4g}",)
        sound = "" if one.found.converged else "no minimum"
        row = (*map(str, counts), *late, *values, *share)
        table.add_row(*row, "chosen" if one is best else sound)
    return table


def _delay(plant: Plant) -> float:
    """The delay of a plant [s]; 0 of one that has none."""
    return float(getattr(plant, "delay", 0.0))


# `identify --state`: the plant of a campaign again, never made worse
# --------------------------------------------------------------------------------------------------


CLOSED = (
    "note: a loop was closed in these trials, so that the noise of the output is in the input; the "
    "intervals hold only if this noise is white"
)
OTHER_STRUCTURE = (
    "The campaign's plant, {kind}, is none in continuous time with stable poles and real zeros: "
    "one pole, one pair and one zero are fitted. Others: --auto, or --poles, --pairs and --zeros."
)
ENOUGH = 90.0  # [%] of the output that a fit explains, from which on no other start is tried


def identify_campaign(
    state: Path,
    counts: Mapping[str, int | None],
    *,
    delay: int | None = None,
    auto: bool = False,
    plant_file: Path | None = None,
    folder: str | Path | None = None,
    progress: Progress = silent,
) -> Outcome:
    """A plant from the trials of a campaign, and the campaign's plant file with it.

    state: folder of the campaign
    counts: numbers of poles, pairs and zeros; without any, those of the campaign's own plant, or 1
        of each where it is no ModalModel, and none in continuous time with stable poles and real
        zeros
    delay: dead time in samples; None: that of the campaign's own plant
    auto: whether the structure is chosen by a table
    plant_file: plant file to write
    folder: for the figure; out/identify if not given
    """
    opened = open_campaign(state, Given(), new=False)
    measured = record_of(opened.campaign, opened.scenario.machine)
    record, known = measured.record, opened.scenario.machine.plant
    numbers = ", ".join(map(str, measured.trials))
    source = f"{len(measured.trials)} of {measured.measured} trials of {state}: {numbers}"
    progress("fitting")
    tables, said = [], []
    if auto:
        late = round(_delay(known) / record.dt) if delay is None else delay
        orders = identification.compare_orders(record, delay=late)
        best = identification.best_order(orders)
        again = _judged(record, known, best.found)
        tables.append(orders_table(orders, best, record.dt))
    else:
        again = _fitted(record, opened.scenario, counts, delay)
        if _own(counts, delay) and _as_known(known) is None:
            said.append(OTHER_STRUCTURE.format(kind=type(known).__name__))
    found, unit = again.found, opened.campaign.task.unit
    tables.append(identification_table(source, found.summary()))
    lines = said + ([] if found.white else [NOT_WHITE])
    lines += map(sentence, identification.not_significant(found))
    lines += [f"{name} keeps its value and its interval: {why}" for name, why in again.kept.items()]
    lines += [CLOSED] * measured.closed
    beyond = sorted(beyond_nyquist(found, record.dt))
    lines.append(_verdict(again, beyond, unit))
    better = again.better and not beyond
    warnings: list[str] = []
    kept: list[Path] = []
    margins: dict[str, float] = {}
    if not better:
        lines.append(
            "next: go on with the plant file as it is: jaxilc next --state "
            f"{shlex.quote(str(state))} --measured TRIAL --out next.csv"
        )
    elif plant_file is not None:
        kept = [_write(plant_file, opened, again, source)]
        after, warnings, margins = _after(plant_file, state, opened)
        lines += after
    used = {"trials": list(measured.trials), "closed_loop": measured.closed, "verdict": lines}
    judged = {"kept": again.kept, "before": again.before, "after": again.after, "better": better}
    units = opened.campaign.task.input_unit, unit
    draw = partial(figures.validation_figure, record, found)
    return Outcome(
        command="identify",
        numbers=numbers_of(found) | used | judged | {"margin": margins},
        verdict=Verdict(tuple(lines)),
        folder=Path(folder or "out/identify"),
        tables=tables,
        warnings=warnings,
        figures={"validation": Figure(CAPTIONS["validation"], draw, live=True)},
        kept=kept,
        live=Fitted(record, found, record.dt, {}, tables, units).live,
        asked=counts,
    )


def _verdict(again: Refit, beyond: list[str], unit: str) -> str:
    """Which of the two plants predicts the trials that were not fitted better."""
    before, after = (f"{of:.3g} {unit}".rstrip() for of in (again.before, again.after))
    fit = f"{float(np.min(again.found.fit)):.4g} %"
    if beyond:
        return (
            f"verdict: the fit puts {', '.join(beyond)} beyond the Nyquist frequency, where no "
            "sample can have seen it, so it is refused and the plant file stays; give a smaller "
            "structure (--poles, --pairs)"
        )
    if not again.better:
        return (
            f"verdict: the plant file stays, since it predicts the last trials, which were not "
            f"fitted, as well: rms error {before}, of the new fit {after}"
        )
    return (
        f"verdict: the plant of these trials explains {fit} of their output, and predicts the last "
        f"ones, which were not fitted, better: rms error {after} in place of {before}"
    )


def _judged(record: Record, known: Plant, found: Identified) -> Refit:
    """A fit that begins anew, beside the known plant."""
    return Refit(found, {}, held_out(record, known), held_out(record, found.plant))


def _own(counts: Mapping[str, int | None], delay: int | None) -> bool:
    """Whether no other structure than that of the campaign's own plant is asked for."""
    return delay is None and all(value is None for value in counts.values())


def _as_known(plant: Plant) -> ProcessModel | ModalModel | None:
    """The plant of a campaign in a form that is fitted again, None where it has none."""
    one = plant.n_u == plant.n_y == 1
    return plant if isinstance(plant, ModalModel) and one else process_model_of(plant)


def _fitted(
    record: Record, scenario: Scenario, counts: Mapping[str, int | None], delay: int | None
) -> Refit:
    """The fit of the structure asked for, or of the campaign's own, from its values if good."""
    plant = scenario.machine.plant
    structure: Numbers = {name: 1 if value is None else value for name, value in counts.items()}
    known = _as_known(plant) if _own(counts, delay) else None
    if known is not None:
        again = refit(record, known, scenario.uncertainty)
        if np.min(again.found.fit) >= ENOUGH or isinstance(known, ModalModel):
            return again._replace(before=held_out(record, plant))
        structure = _counts(known)
    late = round(_delay(plant) / record.dt) if delay is None else delay
    return _judged(record, plant, identification.identify(record, **structure, delay=late))


def _write(path: Path, opened: Opened, again: Refit, source: str) -> Path:
    """Write the plant file of the campaign with the fitted plant, and what it is known by."""
    recipe = opened.recipe
    own = Path(recipe["scenario"])
    if "file" not in recipe or own.suffix != ".toml":
        raise ValueError(
            f"the campaign belongs to {recipe['scenario']}, which is no plant file in TOML; the "
            "fitted plant is above, and --out FOLDER takes its figure"
        )
    found = again.found
    noise = float(max(found.residual_std)) if found.white else None
    notes = [] if found.white else [NOT_WHITE]
    notes += [f"{name}: as before, since {why}" for name, why in again.kept.items()]
    notes.append(
        f"rms error of prediction of the last trials: {again.after:.4g}, before {again.before:.4g}"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_refitted(path, own, found, fitted_to=source, noise=noise, notes=notes)


def _after(
    path: Path, state: Path, opened: Opened
) -> tuple[list[str], list[str], dict[str, float]]:
    """What to do with the new plant file, a warning where the campaign cannot go on, margins."""
    file, folder = shlex.quote(str(path)), shlex.quote(str(state))
    try:
        now = open_campaign(state, Given(scenario=str(path)), new=False)
    except ValueError as error:
        name = shlex.quote(opened.recipe["scheme"])
        start = (
            "next: the scheme of the new file is another one, so start a campaign with it: jaxilc "
            f"next --state FOLDER --scenario {file} --scheme {name} --out next.csv"
        )
        return [start], [f"warning: {error}"], {}
    try:
        before, after = map(_margin, (opened, now))
    except ValueError as error:
        said, margins = [f"note: the margin of the law is not computed: {error}"], {}
    else:
        margins = {"before": before, "after": after}
        said = [
            f"the law: |Q (1 - L P)| is at most {after:.3f} on the new plant and within its "
            f"intervals, {before:.3f} by the old file"
            + ", so neither is proved safe"
            * (min(before, after) >= 1)
        ]
        if before < 1 <= after:
            said.append(f"next: this is no longer safe, a new law: jaxilc design {file}")
            why = "the law of the campaign is not safe on the new plant; do not go on with it"
            return said, [f"warning: {why}"], margins
    on = (
        f"next: go on with the new file: jaxilc next --state {folder} --scenario {file} "
        "--measured TRIAL --out next.csv; its uncertainty is what is predicted from then on"
    )
    return [*said, on], [], margins


def _margin(opened: Opened) -> float:
    """The largest |Q (1 - L P)| of a campaign's law over its machines; inf if one is unstable."""
    of, campaign = opened.scenario, opened.campaign
    answered, _ = question(of.machine, campaign.scheme, campaign.task, of.uncertainty)
    return float(answered.now.peak) if answered.stable else np.inf
