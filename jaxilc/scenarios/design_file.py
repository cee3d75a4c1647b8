"""The plant file that a design leaves, and a plant file with one scheme more."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import tomlkit

from ..pytree.aliases import Tree, Value
from ..pytree.fields import kind_of
from ..schemes import Scheme
from ..storage.files import write_file
from ..storage.reading import printable
from .from_file import read_scenario
from .parameters import plain, same
from .specification import HIDDEN, classes

# A scheme as a table of a plant file
# --------------------------------------------------------------------------------------------------


def table_of(made: Tree) -> dict[str, Value]:
    """The table of a scheme, a filter or a model, with the name of its class.

    Fields that have their default value are left out. Raises ValueError for a class that a file
    cannot name.
    """
    cls = type(made)
    if classes().get(cls.__name__) is not cls:
        raise ValueError(f"{cls.__name__} is no class that a plant file can name")
    table: dict[str, Value] = {"class": cls.__name__}
    for field in dataclasses.fields(made):
        value = getattr(made, field.name)
        if field.name in HIDDEN or value is None or same(value, field.default):
            continue
        if kind_of(field) != "child":
            table[field.name] = plain(value)
        elif isinstance(value, tuple):
            table[field.name] = [table_of(one) for one in value]
        else:
            table[field.name] = table_of(value)
    return table


def toml_of(schemes: Mapping[str, Scheme]) -> str:
    """The tables `[schemes.NAME]` as text; parts of a scheme are tables in one line.

    Raises ValueError as `table_of` does.
    """
    tables = {f"schemes.{toml_key(name)}": table_of(scheme) for name, scheme in schemes.items()}
    return "\n".join(f"[{name}]\n{toml_lines(table)}" for name, table in tables.items())


def toml_lines(table: Mapping[str, Value]) -> str:
    """The keys and values of a table, each in a line."""
    return "".join(f"{toml_key(name)} = {toml_value(value)}\n" for name, value in table.items())


def toml_value(value: Value) -> str:
    """A value of a plant file as TOML, a table in one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    return tomlkit.item(value).as_string()


def toml_key(name: str) -> str:
    return tomlkit.key(name).as_string()


def without_tables(text: str, names: Iterable[str]) -> str:
    """The text of a TOML file without these tables; all else stays as it is."""
    document = tomlkit.parse(text)
    for name in names:
        document.pop(name, None)
    return tomlkit.dumps(document)


def write_with_scheme(path: Path, source: str, name: str, scheme: Scheme) -> tuple[Path, bool]:
    """Write a plant file with one scheme more, and say whether a command can take it.

    A TOML file is written as it is with the table of the scheme below. Where the source is none, or
    names files that are not found from the folder of the new file, the table alone is written, to
    be added to a file by hand.
    """
    table = f"\n# Found by `jaxilc filter`.\n{toml_of({name: scheme})}"
    before = Path(source).read_text(encoding="utf-8") if Path(source).suffix == ".toml" else ""
    write_file(path, before + table)
    if before:
        try:
            read_scenario(path)
            return path, True
        except (ValueError, OSError):
            write_file(path, table)
    return path, False


# The plant file that a design leaves
# --------------------------------------------------------------------------------------------------


def design_path(source: str | Path, what: str = "design") -> Path:
    """The name of the design of a plant file: axis.design.toml for axis.toml."""
    source = Path(source)
    return source.with_name(f"{source.stem}.{what}{source.suffix}")


def need_same_folder(source: str | Path, path: str | Path) -> None:
    """Raises ValueError where a design would lie in another folder than its plant file.

    The names of files in a plant file are relative to its folder.
    """
    here, there = Path(source).resolve().parent, Path(path).resolve().parent
    if here != there or Path(source).resolve() == Path(path).resolve():
        raise ValueError(
            f"--out {path} is not allowed; a design lies beside {source}, under another name"
        )
    if Path(path).suffix != Path(source).suffix:
        raise ValueError(f"--out {path} must end with {Path(source).suffix}, as {source} does")


def write_design(
    path: str | Path, source: str | Path, schemes: Mapping[str, Scheme], said: Iterable[str]
) -> Path:
    """Write a plant file with other schemes, and read it back to be sure of it.

    source: the plant file; its comments and all its other tables are kept, but for a grid, whose
        axes may be those of its schemes
    Raises ValueError where a scheme is of a class that no file can name.
    """
    tables = {name: table_of(scheme) for name, scheme in schemes.items()}
    head = "".join(f"# {printable(' '.join(line.split()))}\n" for line in said)
    changed = {"schemes": tables, "grid": None}
    path = _with_tables(Path(path), Path(source), changed, toml_of(schemes), head)
    read_scenario(path)
    return path


def write_potential(path: str | Path, found: Mapping[str, float], unit: str) -> Path:
    """Write a table [potential] into a plant file, in place of one that it has.

    found: numbers by name
    unit: of the errors; empty where it is not known
    Raises ValueError where learning has nothing to gain, and where the file has another unit.
    """
    path = Path(path)
    own = read_scenario(path).task.unit
    if not all(value > 0 for value in found.values()):
        raise ValueError(f"{path}: learning has nothing to gain, so that no table is written")
    if unit and own and unit != own:
        raise ValueError(f"{path} has the unit {own!r}, the repeats have {unit!r}; allowed is one")
    head = "[potential]  # by `jaxilc potential`: rms errors, and a frequency in Hz"
    table = f"{head}\n{toml_lines(found)}"
    return _with_tables(path, path, {"potential": dict(found)}, table)


def _with_tables(
    path: Path, source: Path, changed: Mapping[str, Value], toml: str, head: str = ""
) -> Path:
    """Write a plant file with other tables at its end; the rest of it stays as it is.

    changed: tables by name, None for one that goes
    toml, head: of a TOML file the text of these tables, and what stands above all
    """
    text = source.read_text(encoding="utf-8")
    if source.suffix == ".json":
        content = json.loads(text) | changed
        kept = {name: table for name, table in content.items() if table is not None}
        written = json.dumps(kept, indent=1, ensure_ascii=False) + "\n"
    else:
        written = f"{head}{without_tables(text, changed).rstrip()}\n\n{toml}"
    write_file(path, written)
    return path
