"""For tests of kills and of damage, this module holds a small store.

It can be filled, whatever it already contains.
"""

import numpy as np

from jaxilc.sweeps.store import Layout, Store, Variable

LAYOUT = Layout(
    {"rms": Variable(("scheme", "sample"), "f8"), "finite": Variable(("scheme", "sample"), "bool")},
    {"scheme": (("scheme",), np.array(["one"])), "sample": (("sample",), np.arange(5))},
    chunk=3,
    configuration={"seed": 1},
)
FIGURES = {
    "rms": np.array([0.1, np.nan, 0.0, np.inf, 2.0]),
    "finite": np.array([True, False, True, False, True]),
}


def filled(path):
    """Fill the store at a path to the end, whatever it already contains.

    Returns its dataset, and the chunks that were written.
    """
    written = []
    with Store.resume(path, LAYOUT) if path.exists() else Store.create(path, LAYOUT) as store:
        for chunk, samples in enumerate((slice(0, 3), slice(3, 5))):
            if not store.is_done(0, chunk):
                store.write(
                    0, chunk, samples, {name: values[samples] for name, values in FIGURES.items()}
                )
                written.append(chunk)
        return store.dataset(), written
