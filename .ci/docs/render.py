"""The documentation: the guide, and a page for each public module by pdoc.

`render.py FOLDER` writes it. Without a folder it only checks that it can be made. A warning of pdoc
and a broken link of the guide are errors.
"""

import sys
import tempfile
import typing
import warnings
from importlib import import_module
from pathlib import Path

import pages
import pdoc

import jaxilc

ROOT = Path(jaxilc.__file__).parent
INTERNAL = ("bench", "cli", "storage")  # families that users do not import from
FAMILIES = sorted(
    f"jaxilc.{path.stem}"
    for path in ROOT.iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", *INTERNAL)
)


def settle(found) -> None:
    """Put a NamedTuple's annotations on its constructor, where pdoc looks for them, and drop `Alias
    for field number 0`.
    """
    if isinstance(found, type) and issubclass(found, tuple) and hasattr(found, "_fields"):
        found.__new__.__annotations__ = typing.get_type_hints(found)
        for field in found._fields:
            getattr(found, field).__doc__ = ""


for family in (
    "jaxilc",
    *FAMILIES,
):  # names are imported on first use, which pdoc does not wait for
    module = import_module(family)
    for name in getattr(module, "__all__", ()):
        vars(module)[name] = getattr(module, name)
for module in [module for name, module in sys.modules.items() if name.startswith("jaxilc.")]:
    for found in list(vars(module).values()):
        settle(found)
warnings.simplefilter("error")
pdoc.render.configure(template_directory=Path(__file__).parent, show_source=False)
with tempfile.TemporaryDirectory() as nowhere:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else nowhere)
    # the package names some families itself, and pdoc finds those
    others = [name for name in FAMILIES if name.partition(".")[2] not in jaxilc.__all__]
    pdoc.pdoc("jaxilc", *others, output_directory=folder)
    pages.write(folder, ["jaxilc", *FAMILIES])
