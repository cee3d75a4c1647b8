"""The certificate of an exported law, and the proof that folder, code and vectors belong to it.

`certificate.json` holds what is claimed, and the SHA-256 of each file. The code carries the digest
of what is claimed. Neither is a signature: whoever changes all of them can make them agree.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from ..pytree.aliases import Value
from ..storage.reading import LARGEST_TREE, read_bytes
from ..storage.sealed import Damaged, checksum, read_json, seal_of, sealed, unsealed

CERTIFICATE = "certificate.json"
DIGEST, FILES = "certificate", "files"
WRITTEN = {"law.h", "law.c", "law_test.c", "law.comp", "law.st"} | {  # by exports of any format
    f"{block}_fmi{version}.fmu" for block in ("law", "plant") for version in (2, 3)
}
CARRIED = re.compile(rb"""["']([0-9a-f]{64})["']""")


def certificate_of(
    claims: Mapping[str, object], files: Mapping[str, str | bytes]
) -> dict[str, Value]:
    """The content of `certificate.json`.

    files: the contents of the other files by name
    """
    hashes = {
        name: checksum(content.encode() if isinstance(content, str) else content)
        for name, content in files.items()
    }
    return sealed({**claims, DIGEST: seal_of(claims), FILES: hashes})


def of_others(folder: Path, files: Iterable[str]) -> list[str]:
    """What is told of the files in a folder that an export of these files has not written."""
    return [f"{folder / name} is of another export, and the certificate does not speak of it"
            for name in sorted(WRITTEN - {*files}) if (folder / name).exists()]  # fmt: skip


def check(folder: str | Path) -> dict[str, Value]:
    """The claims of a folder whose files belong together.

    Raises ValueError naming each file that is missing, was changed or is of another export, also
    the plant file, where it is still where it was; and FileNotFoundError where there is no
    certificate.
    """
    folder = Path(folder)
    try:
        content = unsealed(read_json(folder / CERTIFICATE))
    except Damaged as error:
        raise ValueError(f"{folder / CERTIFICATE} was changed: {error}") from None
    hashes = content.pop(FILES, None)
    digest = content.pop(DIGEST, None)
    if not isinstance(hashes, dict) or digest != seal_of(content):
        raise ValueError(
            f"{folder / CERTIFICATE} was changed: its claims are not those it began with"
        )
    wrong = []
    for name, known in hashes.items():
        path = folder / Path(name).name
        if not path.is_file():
            wrong.append(f"{path} is missing")
            continue
        found = read_bytes(path, LARGEST_TREE)
        carried = {one.decode() for one in CARRIED.findall(found)} - {digest}
        if carried:
            wrong.append(f"{path} carries the certificate {sorted(carried)[0][:12]} of another law")
        elif checksum(found) != known:
            wrong.append(f"{path} was changed")
    wrong += of_others(folder, hashes)
    plant = content.get("plant_file") or {}
    given = Path(str(plant.get("path", "")))
    there = plant.get("path") and given.is_file()
    if there and checksum(read_bytes(given, LARGEST_TREE)) != plant.get("sha256"):
        wrong.append(f"{given}, from which the law was made, was changed")
    if wrong:
        raise ValueError("; ".join(wrong))
    return content
