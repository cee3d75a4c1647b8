"""Sweeps whose learning is compiled for this processor."""

import numpy as np
import pytest
from cases import SCHEMES, case

from jaxilc.runtime import setup
from jaxilc.runtime.start import native_wanted
from jaxilc.sweeps import Sweep, open_dataset
from jaxilc.sweeps.store import stored_configuration
from jaxilc.uncertainty import Uniform

GAIN = {"plant.b": Uniform(0.9, 1.1, relative=True)}


def sweep(names=("p_type", "ffdl_sign", "p_type_butterworth"), **options):
    machine, _, task = case("arx")
    schemes = {name: SCHEMES[name] for name in names}
    how = {"uncertainty": GAIN, "machines": 21, "chunk": 12, "keep": ("y",), **options}
    return Sweep(machine, schemes, task, trials=4, **how)


def test_a_store_says_which_computed_it_and_is_resumed_by_the_same(tmp_path, monkeypatch):
    wanted = sweep().run()
    monkeypatch.setenv("JAXILC_NATIVE", "on")
    found = sweep().run(tmp_path / "s")
    environment = stored_configuration(tmp_path / "s")["environment"]
    assert environment["native"] == ["p_type", "ffdl_sign"]
    assert "llvmlite" in environment["versions"]
    for name in wanted:
        x, y = found[name].values, wanted[name].values
        if y.dtype.kind == "f":
            np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-13, err_msg=name)
            assert (x[2] == y[2]).all()  # which XLA computed
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)
    assert not (found["rms"].values[1] == wanted["rms"].values[1]).all()  # it did compute
    again = sweep().run(tmp_path / "s", resume=True)
    np.testing.assert_array_equal(again["rms"], found["rms"])
    monkeypatch.setenv("JAXILC_NATIVE", "off")
    with pytest.raises(ValueError, match=r"environment\.native"):
        sweep().run(tmp_path / "s", resume=True)
    np.testing.assert_array_equal(open_dataset(tmp_path / "s")["rms"], found["rms"])


def test_what_is_not_known_is_computed_by_xla(monkeypatch):
    monkeypatch.setenv("JAXILC_NATIVE", "on")
    unknown = ("p_type_butterworth",)
    host = sweep(unknown).host()
    assert "native" not in host.environment
    found = sweep(unknown).run()
    monkeypatch.setenv("JAXILC_NATIVE", "off")
    np.testing.assert_array_equal(found["rms"], sweep(unknown).run()["rms"])


def test_the_switch_is_on_off_or_named(monkeypatch):
    monkeypatch.delenv("JAXILC_NATIVE", raising=False)
    assert not native_wanted()
    for text, wanted in (("", False), ("off", False), ("on", True)):
        monkeypatch.setenv("JAXILC_NATIVE", text)
        assert native_wanted() is wanted
    monkeypatch.setenv("JAXILC_NATIVE", "yes")
    with pytest.raises(ValueError, match="JAXILC_NATIVE = 'yes' is not one of 'on', 'off'"):
        setup()
    setup(native=False)
    assert not native_wanted()
