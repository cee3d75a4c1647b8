"""Pages of the API: one for each family, each public name once, with readable types."""

from importlib import import_module
from pathlib import Path
from typing import Any

import jaxilc

ROOT = Path(jaxilc.__file__).parent
INTERNAL = ("cli", "storage")  # families that users do not import from
FAMILIES = sorted(
    f"jaxilc.{path.stem}"
    for path in ROOT.iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", "__main__", *INTERNAL)
)


def write(folder: Path) -> list[str]:
    """Write a page for each family and one for the package; return the names of the pages."""
    (folder / "api").mkdir(parents=True)
    written: dict[int, str] = {}
    names = []
    for family in [*FAMILIES, "jaxilc"]:
        module = import_module(family)
        lines = [f"{family}\n{'=' * len(family)}\n", f".. automodule:: {family}\n   :no-members:\n"]
        for name in _public(module, family):
            lines.append(_entry(family, name, getattr(module, name), written))
        (folder / "api" / f"{family}.rst").write_text("\n".join(lines), encoding="utf-8")
        names.append(f"api/{family}")
    return [names[-1], *names[:-1]]


def _public(module: Any, family: str) -> list[str]:
    """The public names of a family: those it lists, or those that it defines itself."""
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return sorted(listed)
    return sorted(
        name
        for name, found in vars(module).items()
        if not name.startswith("_") and getattr(found, "__module__", None) == family
    )


def _entry(family: str, name: str, found: Any, written: dict[int, str]) -> str:
    """The directive of a name; one that another page has is a line that says where."""
    kind = type(found).__name__
    if kind == "module":
        return f"``{name}``\n    :doc:`jaxilc.{name}`\n" if f"jaxilc.{name}" in FAMILIES else ""
    if not callable(found):
        return f"``{name}``\n    a constant\n"
    if id(found) in written:
        return f"``{name}``\n    see :doc:`{written[id(found)]}`\n"
    written[id(found)] = family
    if isinstance(found, type):
        return f".. autoclass:: {family}.{name}\n   :members:\n"
    return f".. autofunction:: {family}.{name}\n"
