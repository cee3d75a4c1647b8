"""Sweeps whose learning is compiled for this processor."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import SCHEMES, case

from jaxilc.learning import learn
from jaxilc.native.run import sample_steps
from jaxilc.runtime import setup, start
from jaxilc.runtime.start import WORTH, native_unwanted
from jaxilc.sweeps import Sweep, open_dataset
from jaxilc.sweeps.store import stored_configuration
from jaxilc.uncertainty import Uniform

GAIN = {"plant.b": Uniform(0.9, 1.1, relative=True)}


def sweep(*names):
    machine, _, task = case("arx")
    schemes = {name: SCHEMES[name] for name in names or ("p_type", "pid_position")}
    return Sweep(machine, schemes, task, trials=4, uncertainty=GAIN, machines=21, chunk=12,
                 keep=("y",))  # fmt: skip


def test_a_store_says_which_computed_it_and_is_resumed_by_the_same(tmp_path, monkeypatch):
    wanted = sweep().run()
    monkeypatch.setenv("JAXILC_NATIVE", "on")
    found = sweep().run(tmp_path / "s")
    environment = stored_configuration(tmp_path / "s")["environment"]
    assert environment["native"] == ["p_type"]
    assert "llvmlite" in environment["versions"]
    for name in wanted:
        x, y = found[name].values, wanted[name].values
        if y.dtype.kind == "f":
            np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-13, err_msg=name)
            assert (x[1] == y[1]).all()  # which XLA computed
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)
    assert not (found["rms"].values[0] == wanted["rms"].values[0]).all()  # it did compute
    again = sweep().run(tmp_path / "s", resume=True)
    np.testing.assert_array_equal(again["rms"], found["rms"])
    monkeypatch.setenv("JAXILC_NATIVE", "off")
    with pytest.raises(ValueError, match=r"environment\.native"):
        sweep().run(tmp_path / "s", resume=True)
    np.testing.assert_array_equal(open_dataset(tmp_path / "s")["rms"], found["rms"])


def test_the_switch_is_auto_on_off_or_named(monkeypatch):
    """Where nothing is said, what is worth the time is compiled, and of one machine nothing is."""
    monkeypatch.delenv("JAXILC_NATIVE", raising=False)
    assert "10 sample-steps, where fewer than" in native_unwanted(lambda: 10)
    assert native_unwanted(lambda: WORTH) is None
    for text, wanted in (("", False), ("auto", False), ("off", False), ("on", True)):
        monkeypatch.setenv("JAXILC_NATIVE", text)
        assert (native_unwanted(lambda: 10) is None) is wanted
    monkeypatch.setenv("JAXILC_NATIVE", "yes")
    with pytest.raises(ValueError, match="JAXILC_NATIVE = 'yes' is not one of 'auto', 'on', 'off'"):
        setup()
    setup(native=False)
    assert native_unwanted(lambda: WORTH) == "JAXILC_NATIVE is off"
    monkeypatch.delenv("JAXILC_NATIVE")
    monkeypatch.setattr(start, "find_spec", lambda name: None)
    assert "llvmlite is not installed" in native_unwanted(lambda: WORTH)


def test_a_sweep_that_is_worth_it_is_compiled_without_being_asked(monkeypatch):
    monkeypatch.delenv("JAXILC_NATIVE", raising=False)
    one = sweep("p_type")
    assert "native" not in one.host().environment
    monkeypatch.setattr(start, "WORTH", 21 * 4 * one.task.N)
    assert one.host().environment["native"] == ["p_type"]
    assert "native" not in sweep("p_type_butterworth").host().environment  # it is not known


def test_the_steps_of_what_is_computed_are_counted():
    machine, _, task = case("arx")

    def loss(common, gain):
        machine, scheme = common
        return jnp.sum(learn(machine, dataclasses.replace(scheme, gamma_p=gain), task, 4).rms)

    of = (machine, SCHEMES["p_type"]), np.ones(3)
    steps = sample_steps(loss, *of)
    assert steps == 3 * 4 * 2 * task.N  # the law sums the errors in a loop of its own
    slope = sample_steps(jax.value_and_grad(loss, argnums=1), *of)
    assert 2 * steps <= slope <= 6 * steps
