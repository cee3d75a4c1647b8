"""The plant file that a design leaves: the file it began with, with the recommended law in it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import tomlkit

from ..schemes import Scheme
from ..storage.files import atomically
from ..storage.printable import printable
from .from_file import read_scenario
from .scheme_table import table_of, toml_of


def design_path(source: str | Path, what: str = "design") -> Path:
    """The name of the design of a plant file: axis.design.toml for axis.toml.

    what: the middle of the name
    """
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
    schemes: by name, in place of those of the file
    said: sentences for the head of the file
    Raises ValueError where a scheme is of a class that no file can name.
    """
    source, path = Path(source), Path(path)
    text = source.read_text(encoding="utf-8")
    if source.suffix == ".json":
        tables = {name: table_of(scheme) for name, scheme in schemes.items()}
        content = json.loads(text) | {"schemes": tables}
        content.pop("grid", None)
        written = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    else:
        written = _toml(text, schemes, said)
    atomically(path, lambda file: file.write(written.encode()))
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
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        content = json.loads(text) | {"potential": dict(found)}
        written = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    else:
        document = tomlkit.parse(text)
        document.pop("potential", None)
        lines = "".join(f"{name} = {value!r}\n" for name, value in found.items())
        head = "[potential]  # by `jaxilc potential`: rms errors, and a frequency in Hz"
        written = f"{tomlkit.dumps(document).rstrip()}\n\n{head}\n{lines}"
    atomically(path, lambda file: file.write(written.encode()))
    return path


def _toml(text: str, schemes: Mapping[str, Scheme], said: Iterable[str]) -> str:
    """The text of a TOML file with other schemes, and with sentences at its head."""
    document = tomlkit.parse(text)
    for name in ("schemes", "grid"):
        document.pop(name, None)
    head = "".join(f"# {printable(' '.join(line.split()))}\n" for line in said)
    return f"{head}{tomlkit.dumps(document).rstrip()}\n\n{toml_of(schemes)}"
