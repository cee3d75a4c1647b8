"""The library's pages, by pdoc, where a warning is an error: `render.py FOLDER`; without a folder,
whether they can be made.
"""

import sys
import tempfile
import typing
import warnings
from pathlib import Path

import pdoc

import jaxilc


def settle(found) -> None:
    """Put a NamedTuple's annotations on its constructor, where pdoc looks for them, and drop `Alias
    for field number 0`.
    """
    if isinstance(found, type) and issubclass(found, tuple) and hasattr(found, "_fields"):
        found.__new__.__annotations__ = typing.get_type_hints(found)
        for field in found._fields:
            getattr(found, field).__doc__ = ""


for name in jaxilc.__all__:  # imported on first use, which pdoc does not wait for
    vars(jaxilc)[name] = getattr(jaxilc, name)
for module in [module for name, module in sys.modules.items() if name.startswith("jaxilc.")]:
    for found in list(vars(module).values()):
        settle(found)
warnings.simplefilter("error")
pdoc.render.configure(template_directory=Path(__file__).parent, show_source=False)
with tempfile.TemporaryDirectory() as nowhere:
    pdoc.pdoc("jaxilc", output_directory=Path(sys.argv[1] if len(sys.argv) > 1 else nowhere))
