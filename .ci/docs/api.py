"""Pages of the API: one for each family, each public name once, with an example that is a test.

`examples/FAMILY.py` has the examples: what comes first is common to all of them, and a heading
`# %% NAME, NAME` stands above the code that shows these names, with what it prints as a comment
below. The names stand on the page in this order. `(slow)` at the end of a heading says that tests
leave it to `make docs`.
"""

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import jaxilc

ROOT = Path(jaxilc.__file__).parent
EXAMPLES = Path(__file__).parent / "examples"
INTERNAL = ("cli", "storage")  # families that users do not import from
FAMILIES = sorted(
    f"jaxilc.{path.stem}"
    for path in ROOT.iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", "__main__", *INTERNAL)
)
SHORT = 40  # letters of a default that a signature shows


class Example(NamedTuple):
    """Code with what it prints, and the public names that it shows."""

    names: tuple[str, ...]
    code: str
    slow: bool


def examples_of(family: str) -> tuple[str, list[Example]]:
    """The lines that all examples of a family begin with, and the examples; nothing without any."""
    path = EXAMPLES / f"{family.rpartition('.')[2]}.py"
    if not path.exists():
        return "", []
    first, *parts = re.split(r"^# %% ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = []
    for part in parts:
        heading, _, code = part.partition("\n")
        names = heading.removesuffix(" (slow)")
        found.append(Example(tuple(names.split(", ")), code.strip() + "\n", names != heading))
    return first.partition('"""\n')[2].strip() + "\n", found


def write(folder: Path) -> list[str]:
    """Write a page for each family and one for the package; return the names of the pages."""
    (folder / "api").mkdir(parents=True)
    written: dict[int, str] = {}
    names = []
    for family in [*FAMILIES, "jaxilc"]:
        module = import_module(family)
        begin, examples = examples_of(family)
        lines = [f"{family}\n{'=' * len(family)}\n", f".. automodule:: {family}\n   :no-members:\n"]
        if begin:
            lines += ["All examples of this page begin with", "", _block(begin)]
        public, told = _public(module, family), set()
        for example in examples:
            mine = [name for name in example.names if name in public]
            lines += [_entry(family, name, getattr(module, name), written) for name in mine]
            of = f" of {', '.join(mine)}" * (len(mine) > 1)
            lines += [f".. rubric:: Example{of}\n", _block(example.code)]
            told |= {*mine}
        for name in public:
            if name not in told:
                lines.append(_entry(family, name, getattr(module, name), written))
        (folder / "api" / f"{family}.rst").write_text("\n".join(lines), encoding="utf-8")
        names.append(f"api/{family}")
    return [names[-1], *names[:-1]]


def _block(code: str) -> str:
    return ".. code-block:: python\n\n" + re.sub(r"^(?=.)", "   ", code, flags=re.MULTILINE)


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


def signature(found: Any) -> tuple[str, str | None] | None:
    """Parameters with their defaults, and the result of a function, as a person reads them.

    Shapes, units and meanings stand below it, so no types are repeated; None where Python knows no
    signature.
    """
    try:
        whole = inspect.signature(found)
    except (TypeError, ValueError):
        return None
    of_class = isinstance(found, type)
    parameters = [
        one.replace(annotation=one.empty, default=_default(one.default))
        for one in whole.parameters.values()
        if one.name not in ("self", "cls")
    ]
    result = whole.return_annotation
    told = result if isinstance(result, str) and not of_class else None
    return str(inspect.Signature(parameters)), None if told in ("Value", "Any") else told


class _Written(str):
    """A default as it is written in a signature."""

    __slots__ = ()
    __repr__ = str.__str__


def _default(value: Any) -> Any:
    """What a signature shows of a default; `...` for what has no short form."""
    if value is inspect.Parameter.empty:
        return value
    short = getattr(value, "__name__", None) or repr(value)
    return _Written(short if len(short) < SHORT and "<" not in short else "...")


def setup(app) -> None:
    """Have autodoc write readable signatures."""

    def process(app, what, name, obj, options, args, result):
        del app, name, options, result
        return signature(obj) if what in ("class", "function", "method") and args else None

    app.connect("autodoc-process-signature", process)
