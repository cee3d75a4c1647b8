"""A Zarr store in a folder that writes each value completely to the disk before the next one."""

from __future__ import annotations

import asyncio
from pathlib import Path

from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

from .files import to_disk, write_file


class DurableStore(LocalStore):
    """A local Zarr store that is consistent after a power failure.

    After a power failure, Zarr's own store may have the mark of a chunk without its numbers.
    """

    async def set(self, key: str, value: Buffer) -> None:
        await asyncio.to_thread(write_below, self.root, key, value.to_bytes())


def write_below(root: Path, key: str, content: bytes) -> None:
    """Write a file below a folder to the disk, and make the folders between them if needed."""
    path = root / key
    made = [folder for folder in path.parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, content)
    for folder in made:
        to_disk(folder.parent)
