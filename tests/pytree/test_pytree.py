"""These tests check how parameters are validated, named, replaced and batched."""

import dataclasses
import re
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import DT, PLANTS

from jaxilc.filters import ZeroPhaseFIR
from jaxilc.learning import Actuator, Machine, Sensor, check
from jaxilc.plants import TwoAxes, VoiceCoil, voice_coil
from jaxilc.pytree import (
    child,
    get_at,
    interval_at,
    leaf,
    named_leaves,
    pytree,
    replaced,
    settable,
    static,
)
from jaxilc.pytree.fields import Interval
from jaxilc.pytree.ranges import outside, share_text
from jaxilc.schemes import (
    ASMC,
    CFDLMFAILC,
    FFDLMFAILC,
    PID,
    Filtered,
    NormOptimal,
    OnOutputs,
    PIDType,
    Scheme,
    WithFeedback,
)
from jaxilc.signals import Task

MACHINE = Machine(VoiceCoil(), Actuator(limit=5.0), Sensor(resolution=1e-4))
BOTH = {"machine": MACHINE, "scheme": WithFeedback(PIDType(gamma_p=-1.0, lead=2), PID(kp=-4.0))}

OUTSIDE = [  # schemes/test_declared.py has all fields of the schemes
    (PIDType, "leak", 1.0, "[0, 1)"),
    (PIDType, "lead", 1.5, "[0, inf)"),
    (PID, "kp", np.nan, "(-inf, inf)"),
    (PID, "ki", -np.inf, "(-inf, inf)"),
    (Actuator, "limit", 0.0, "(0, inf)"),
]


@pytest.mark.parametrize(("cls", "name", "value", "allowed"), OUTSIDE)
def test_a_number_outside_its_range_is_named_with_it(cls, name, value, allowed):
    said = re.escape(f"{cls.__name__}: {name} = {value:g} is outside its allowed range {allowed}")
    with pytest.raises(ValueError, match=said):
        cls(**{name: value})


NOT_ALLOWED = [
    (FFDLMFAILC, "rho", (0.5, 0.5, -0.1, 0.5), r"= \[ 0.5  0.5 -0.1  0.5\] is outside .*\(0, 1\]"),
    (FFDLMFAILC, "rho", (0.5, 0.5), r"has shape \(2,\)"),
    (FFDLMFAILC, "phi0", (0.5, 0.1), r"has shape \(2,\); L_y = 2 and L_u = 2 need \(4,\)"),
    (PID, "kp", jnp.array([1.0, jnp.nan]), "= .*nan.* is outside its allowed range"),
    (VoiceCoil, "poles", (1.0, np.nan, 2.0), "= .*nan.* is outside its allowed range"),
    (PID, "kp", "high", "= 'high' is not a number or an array of numbers"),
    (PID, "kp", "3", "= '3' is not a number"),
    (PID, "kp", [1.0, [2.0]], "= .* is not a number or an array of numbers"),
    (PID, "kp", 1j, "= 1j is not a number"),
    (PID, "kp", np.array(1j), "= .* is not a number"),
    (PID, "kp", object(), "= .* is not a number"),
    (PID, "kp", None, "= (None|nan) is"),
    (PID, "kp", 10**400, "= 1000.* is not a number"),
    (PID, "kp", jax.random.key(0), "= .* is not a number"),
    (PID, "kp", np.ma.masked, "= masked is not a number"),
    (Task, "reference", np.ma.masked_equal([0.0, 1.0, 2.0], 1.0), "= masked_array.* is not a num"),
    (PID, "form", "velocity", "= 'velocity' is not one of 'position', 'increment'"),
    (CFDLMFAILC, "reset", "always", "= 'always' is not one of 'book', 'sign', 'none'"),
    (PIDType, "lead", "two", r"= 'two' is a str; allowed is a whole number in \[0, inf\)"),
    (PIDType, "lead", 2.0, r"= 2.0 is a float; allowed is a whole number in \[0, inf\)"),
    (Task, "dt", np.array([1e-3]), r"= array.* is a ndarray; allowed is a number in \[1e-12,"),
    (PIDType, "lead", np.array([1, 2]), "= "),
    (PIDType, "lead", 10**5000, "= a int too long to show is outside its allowed range"),
    (PIDType, "lead", 1j, "= 1j is a complex; allowed is a whole number"),
    (Machine, "plant", PID(), "is a PID; allowed is Plant"),
]


@pytest.mark.parametrize(
    ("cls", "name", "value", "said"), NOT_ALLOWED, ids=map(str, range(len(NOT_ALLOWED)))
)
def test_a_value_that_is_not_allowed_is_named_with_what_is(cls, name, value, said):
    with pytest.raises(ValueError, match=f"{cls.__name__}: {name} {said}"):
        cls(**({"reference": np.zeros(3), "dt": DT} if cls is Task else {}) | {name: value})


REFUSED = {
    "part": (
        lambda: WithFeedback(PIDType(), -np.inf),
        "WithFeedback: feedback = -inf is a float; allowed is Scheme",
    ),
    "part_of_two_axes": (
        lambda: TwoAxes(voice_coil(), -np.inf),
        "TwoAxes: y = -inf is a float; allowed is Plant",
    ),
    "part_as_its_class": (
        lambda: Filtered(PID, ZeroPhaseFIR()),
        r"Filtered: scheme = <class .*PID'> is a type; allowed is Scheme",
    ),
    "part_missing": (
        lambda: Filtered(PIDType(), None),
        r"Filtered: filter = None is a NoneType; allowed is Filter \(ZeroPhaseIIR\(b, a\) or",
    ),
    "part_or_none": (
        lambda: Machine(voice_coil(), 3.0),
        "Machine: actuator = 3.0 is a float; allowed are Actuator and None",
    ),
    "one_of_two_parts": (
        lambda: NormOptimal(PLANTS["arx"]),
        "model is a DifferenceEquation; allowed are StateSpace and TimeVarying",
    ),
    "static_kind": (
        lambda: OnOutputs(PID(), 1e6),
        r"OnOutputs: outputs = 1000000.0 is a float; allowed is a tuple \(a whole number, ...\)",
    ),
    "static_elements": (
        lambda: OnOutputs(PID(), (0, 1.0)),
        r"OnOutputs: outputs = \(0, 1.0\) is a tuple; allowed is a tuple",
    ),
    "static_flag": (
        lambda: ASMC(1.0, 1.0, 1.0, carry=1),
        "ASMC: carry = 1 is not one of False, True",
    ),
    "outputs": (
        lambda: OnOutputs(PID(), (0, 2)).check(Task(np.zeros((9, 2)), dt=DT)),
        r"OnOutputs: outputs = \(0, 2\).*0..1",
    ),
}


@pytest.mark.parametrize(("build", "message"), REFUSED.values(), ids=REFUSED)
def test_construction_names_class_field_value_and_range(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_numbers_that_must_be_single_are_looked_at_with_the_task():
    """A batch of machines has many values of each number, so their construction does not refuse
    them.
    """
    task = Task(np.zeros(9), dt=DT)
    batch = Machine(VoiceCoil(zero=(900.0, 950.0)))
    with pytest.raises(
        ValueError, match=r"VoiceCoil: zero = \[900. 950.\] has shape \(2,\); allowed is one number"
    ):
        check(batch, PID(), task)
    jax.vmap(lambda zero: check(replaced(batch, {"plant.zero": zero}), PID(), task) or zero)(
        batch.plant.zero
    )


def test_a_user_s_own_class_fits_where_its_base_does_and_unknown_names_are_not_held_against_it():
    @pytree
    class Own(Scheme):
        inside: "NameOfNowhere" = child()  # noqa: F821
        law: Scheme = child(default=PIDType())

    assert WithFeedback(Own(PID()), PID()).learning.inside is not None
    assert Filtered(Own(3.0), ZeroPhaseFIR()).scheme.inside == 3.0


def test_replace_validates_as_construction_does():
    assert float(dataclasses.replace(PID(), kp=2).kp) == 2.0
    with pytest.raises(
        ValueError, match=r"CFDLMFAILC: lam = -1 is outside its allowed range \(0, inf\)"
    ):
        dataclasses.replace(CFDLMFAILC(), lam=-1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        PID().kp = 1.0


@pytest.mark.parametrize(
    "value",
    [
        2,
        2.0,
        np.float64(2),
        np.array(2),
        np.array(2.0),
        jnp.asarray(2),
        jnp.asarray(2.0),
        jnp.array(2.0),
        np.int32(2),
        np.array(2.0, ">f8"),
        np.array(2, ">i2"),
    ],
)
def test_a_leaf_is_a_strongly_typed_float_whatever_it_was_given(value):
    gain = PID(kp=value).kp
    assert jnp.result_type(gain) == jnp.float64
    assert not jax.typeof(gain).weak_type
    assert float(gain) == 2.0
    assert replaced(voice_coil(), {"poles[1]": value}).poles[1] == 2.0


def test_an_object_has_its_own_numbers_that_nothing_changes_later():
    """One buffer that a loop fills again and again makes tasks of their own."""
    r, tasks = np.zeros(11), []
    for size in (1.0, 2.0):
        r[:] = size
        tasks.append(Task(r, dt=DT))
    assert [float(task.reference[0, 0]) for task in tasks] == [1.0, 2.0]
    of_view = np.asfortranarray(np.ones((2, 11)))
    task = Task(of_view[0], dt=DT)
    of_view[:] = np.nan
    assert np.all(task.reference == 1)
    with pytest.raises(ValueError, match="read-only"):
        task.reference[0] = 5.0


def test_float32_leaves_stay_float32():
    plant = VoiceCoil(poles=np.float32([474, 474, 6]))
    assert plant.poles.dtype == np.float32
    assert replaced(plant, {"poles[1]": 5.0}).poles.dtype == np.float32
    assert PID(kp=jnp.float32(2)).kp.dtype == jnp.float32


def test_double_leaves_are_replaced_in_single_precision_without_a_warning():
    plant, foreign = VoiceCoil(poles=[474.0, 474.0, 6.0]), {"part": (np.zeros(2), "text")}
    with jax.enable_x64(False):
        elements = {f"poles[{i}]": jnp.asarray(1.0 + i) for i in range(3)}
        assert replaced(plant, elements).poles.tolist() == [1.0, 2.0, 3.0]
        assert replaced(foreign, {"part[0]": np.ones(2)})["part"][0].tolist() == [1.0, 1.0]


def test_only_none_and_all_are_0_and_100_percent():
    given = (0.0, 1e-6, 0.0004, 0.05, 0.9994, 4095 / 4096, 1 - 1e-6, 1.0, np.nan)
    said = "0.0% 0.0001% 0.04% 5.0% 99.9% 99.98% 99.9999% 100.0% nan%"
    assert " ".join(map(share_text, given)) == said


@pytest.mark.parametrize(
    ("text", "inside", "outside"),
    [
        ("(0, 1]", (1e-9, 1.0), (0.0, 1.1, np.nan)),
        ("[0, inf)", (0.0, 1e300), (-1e-9, np.inf)),
        ("[-1, 2)", (-1.0, 1.9), (2.0, -1.1)),
    ],
)
def test_interval(text, inside, outside):
    interval = Interval.parse(text)
    assert str(interval) == text
    assert all(interval.contains(v) for v in inside)
    assert not any(interval.contains(v) for v in outside)
    assert not interval.contains([inside[0], outside[0]])
    with pytest.raises(ValueError, match=r"'0\.\.1' is not an interval"):
        Interval.parse("0..1")


def test_leaves_have_names():
    names = named_leaves(BOTH)
    assert list(names)[:5] == [
        "machine.plant.gain",
        "machine.plant.zero",
        "machine.plant.poles",
        "machine.plant.lead",
        "machine.actuator.limit",
    ]
    assert float(names["scheme.feedback.kp"]) == -4.0
    assert len(names) == len(jax.tree.leaves(BOTH))
    assert "scheme.learning.lead" not in names, "a static field is no leaf"
    assert "machine.actuator.rate" not in names, "what is off is no leaf"


def test_settable_lists_leaves_statics_and_what_is_off():
    names = settable(BOTH)
    assert set(named_leaves(BOTH)) < set(names)
    assert names["scheme.learning.lead"] == 2
    assert names["scheme.feedback.form"] == "position"
    assert names["machine.actuator.rate"] is None
    for path, value in names.items():
        assert get_at(BOTH, path) is value
        np.testing.assert_equal(get_at(replaced(BOTH, {path: value}), path), value)


def test_replaced_changes_one_thing_only():
    changes = {
        "machine.plant.poles[1]": 300.0,
        "scheme.learning.lead": 3,
        "machine.actuator.rate": 7.0,
        "scheme.feedback.kp": -5,
    }
    for path, value in changes.items():
        after = replaced(BOTH, {path: value})
        assert get_at(after, path) == value
        for other in set(settable(BOTH)) - {path, path.split("[")[0]}:
            assert get_at(after, other) is get_at(BOTH, other)
    assert float(MACHINE.plant.poles[1]) == 474.0
    np.testing.assert_array_equal(
        replaced(MACHINE, {"plant.poles[2]": 5.0}).plant.poles, [474.0, 474.0, 5.0]
    )
    together = replaced(BOTH, changes | {"machine.plant.poles[0]": 200.0})
    assert all(get_at(together, path) == value for path, value in changes.items())
    np.testing.assert_array_equal(together["machine"].plant.poles, [200.0, 300.0, 6.404])


def test_all_elements_at_once_are_those_one_after_the_other():
    taps = ZeroPhaseFIR([0.4, 0.2, 0.1])
    values = {f"taps[{i}]": jnp.asarray(1.0 + i) for i in (2, 0, 1)}
    np.testing.assert_array_equal(replaced(taps, values).taps, [1.0, 2.0, 3.0])
    slopes = jax.grad(lambda x: jnp.sum(replaced(taps, {**values, "taps[1]": x}).taps ** 2))(5.0)
    assert slopes == 10.0
    del values["taps[0]"]
    np.testing.assert_array_equal(replaced(taps, values).taps, [0.4, 2.0, 3.0])


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            "machine.plant.poles[2]",
            -1.0,
            r"VoiceCoil: poles = .* is outside its allowed range \(0, inf\)",
        ),
        ("scheme.learning.lead", -1, r"PIDType: lead = -1"),
        ("scheme.feedback.form", "P", r"PID: form = 'P' is not one of"),
        ("machine.actuator.limit", "x", r"Actuator: limit = 'x' is not a number"),
    ],
)
def test_replaced_validates(path, value, message):
    with pytest.raises(ValueError, match=message):
        replaced(BOTH, {path: value})


@pytest.mark.parametrize(
    "poles", [(474.0, 474.0, 6.404), jnp.array([474.0, 474.0, 6.404])], ids=["numpy", "jax"]
)
@pytest.mark.parametrize(
    "path",
    [
        "plant.gian",
        "plnt.gain",
        "plant.poles[3]",
        "plant.gain[0]",
        "plant.poles[0][0]",
        "plant.poles[-1]",
    ],
)
def test_unknown_paths_name_what_exists(path, poles):
    machine = Machine(VoiceCoil(poles=poles), Actuator(limit=1.0))
    for attempt in (lambda: get_at(machine, path), lambda: replaced(machine, {path: 1.0})):
        with pytest.raises(KeyError) as error:
            attempt()
        text = str(error.value)
        if "[" in path:
            assert path.split(".")[1] in text
        else:
            assert path in text
            for known in settable(machine):
                assert known in text


def test_ranges_are_found_by_path():
    assert str(interval_at(BOTH, "machine.plant.poles[1]")) == "(0, inf)"
    assert str(interval_at(BOTH, "scheme.learning.leak")) == "[0, 1)"
    assert interval_at(BOTH, "scheme.feedback.form") is None


@pytree
class Inner:
    gain: jax.Array = leaf(default=1.0, interval="(0, 10)")
    order: int = static(default=2, interval="[1, inf)")


@pytree
class Outer:
    inner: Inner = child()
    level: jax.Array | None = leaf(default=None, interval="(0, 1)", optional=True)

    def __post_init__(self):
        if self.inner.order > 5:
            raise ValueError("Outer: order")


def test_transformations_do_not_validate():
    """Tracers, batches, and a gradient step that leaves the range are accepted.

    Only what a user constructs is checked.
    """
    outer = Outer(Inner(gain=2.0))
    batch = jax.tree.map(lambda x: jnp.stack([x, -x]), outer)  # -2 is outside (0, 10)
    np.testing.assert_array_equal(
        jax.vmap(lambda o: o.inner.gain * o.inner.order)(batch), [4.0, -4.0]
    )
    assert (
        float(jax.jit(lambda o: dataclasses.replace(o.inner, gain=-o.inner.gain).gain)(outer))
        == -2.0
    )
    assert float(jax.grad(lambda o: o.inner.gain**2)(outer).inner.gain) == 4.0
    np.testing.assert_array_equal(
        jax.vmap(lambda g: Inner(gain=g).gain)(jnp.array([-1.0, 20.0])), [-1.0, 20.0]
    )
    assert float(jax.jit(lambda v: replaced(voice_coil(), {"poles[1]": v}).poles[1])(7.0)) == 7.0


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (np.float16(1e-3), 0x419 / 2**20),  # the nearest of 11 bits
        (np.float32(1e-3), 0x83126F / 2**33),
        (np.longdouble(1e-3), 1e-3),
        (np.array(1e-3), 1e-3),
        (jnp.array(1e-3), 1e-3),
        (Fraction(1, 1000), 1e-3),
        (1, 1.0),
    ],
    ids=str,
)
def test_a_static_number_is_the_same_wherever_it_is_equal(given, meant):
    """To NumPy np.float16(1e-3) is 1e-3, and one program of JAX would serve both."""
    of_dt = jax.jit(lambda task: task.dt + 0 * task.reference[0, 0])
    of = [Task(np.zeros(3), dt=dt, settle=[0, dt]) for dt in (given, meant, 1e-3)]
    assert [float(of_dt(task)) for task in of] == [meant, meant, 1e-3]
    assert {type(x) for x in (of[0].dt, *of[0].settle)} == {float}
    assert type(PIDType(lead=np.int8(2)).lead) is type(OnOutputs(PID(), [np.array(1)]).outputs[0])


def test_a_static_number_is_a_number_of_python_at_any_depth():
    @pytree
    class Nested:
        w: tuple = static(default=())

    found = Nested(w=[[np.float16(1e-3), [np.array(2)]], ["a"]]).w
    assert found == ((0x419 / 2**20, (2,)), ("a",))
    assert [type(x) for x in (found[0][0], found[0][1][0])] == [float, int]


def test_a_static_number_cannot_be_traced():
    for transformed in (jax.jit, jax.vmap):
        with pytest.raises(ValueError, match="Task: dt is traced; allowed is a static value"):
            transformed(lambda dt: Task(np.zeros(3), dt=dt).dt)(np.ones(2))


def test_statics_belong_to_the_structure_and_own_checks_run():
    assert jax.tree.structure(Inner(order=2)) != jax.tree.structure(Inner(order=3))
    assert jax.tree.structure(Inner(gain=1.0)) == jax.tree.structure(Inner(gain=9.0))
    with pytest.raises(ValueError, match="Outer: order"):
        replaced(Outer(Inner()), {"inner.order": 6})
    assert hash(Inner()) is not None


def test_a_message_tells_a_number_from_the_range_that_it_is_outside_of():
    """500.00001 Hz was told as 500 Hz, and 1666.668 Hz as outside (0, 1666.67)."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        low, high = np.sort(rng.uniform(-1e3, 1e3, 2))
        wanted = Interval(low, high, *rng.random(2) < 0.5)
        at, by = (low, -1) if rng.random() < 0.5 else (high, 1)
        value = at + by * abs(at) * 10.0 ** rng.uniform(-15, 1)
        text = outside(value, wanted, " Hz")
        said = re.fullmatch(r"(\S+) Hz is outside its allowed range (.*)", text)
        told, within = float(said[1]), Interval.parse(said[2])
        assert np.sign(told - within.low) == np.sign(value - low)
        assert np.sign(told - within.high) == np.sign(value - high)
    assert outside(2.5, Interval.parse("[1, 2]")) == "2.5 is outside its allowed range [1, 2]"
