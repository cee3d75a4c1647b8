"""Writing of files and folders completely or not at all, also if the process is killed.

The same holds if the power fails. A file or folder first has a temporary name, `.unfinished-...` in
the same folder, and is renamed when it is on the disk. While a process writes, it holds a lock on
the temporary name. A temporary name without a lock was left by a process that was killed; the next
process that writes into the folder removes it. Where a file system cannot lock, such as a folder on
NFS, nothing is removed and nothing is refused.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows has no fcntl; there, nothing is removed and nothing is refused
    fcntl = None  # type: ignore[assignment]

UNFINISHED = ".unfinished-"
_TEMPORARY = re.compile(re.escape(UNFINISHED) + r"\d+-[0-9a-f]{8}")  # process, random digits
STREAMS = ("/dev/std", "/dev/fd/", "/proc/")  # names of files that the process has open already


def atomically(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file completely or not at all.

    path: file to write; a link is followed

    A pipe or a device cannot be replaced and is written to directly. Raises OSError with the name
    of the file, where the disk is full or the folder was removed too.
    """
    path = Path(path)
    if (path.exists() and not path.is_file()) or str(path.absolute()).startswith(STREAMS):
        with open(path, "wb") as file:
            write(file)
        return
    path = Path(os.path.realpath(path))
    try:
        with _aside(path.parent, Path.touch) as unfinished:
            with open(unfinished, "wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        to_disk(path.parent)
    except OSError as error:  # which may name the temporary name
        raise OSError(error.errno, error.strerror, str(path)) from None


def write_file(path: str | Path, content: str | bytes) -> None:
    """Write a file of a text, as UTF-8, or of bytes; completely or not at all, as `atomically`."""
    whole = content.encode() if isinstance(content, str) else content
    atomically(path, lambda file: file.write(whole))


def need_free(path: str | Path) -> None:
    """Raises FileExistsError for a place where something is that is not to be gone on with.

    Where another process is writing there, ValueError names it.
    """
    need_unused(path)
    if Path(path).exists():
        raise FileExistsError(f"{path} exists already; resume it or choose another place")


def need_unused(path: str | Path) -> None:
    """Raises ValueError that names the process that uses a folder, or a folder in it."""
    if Path(path).is_dir():
        for folder in (Path(path), *Path(path).iterdir()):
            if folder.is_dir():
                with only_one(folder):
                    pass


@contextlib.contextmanager
def whole_folder(path: str | Path, *, replace: bool = False) -> Generator[Path]:
    """A context with a folder to fill, which gets its name when the block ends without an error.

    path: name of the folder; folders above it are made if needed
    replace: whether a folder that has this name already is replaced
    Raises FileExistsError where the name exists at that time and is not to be replaced.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if _replaced(path).exists() and not path.exists():
        os.rename(_replaced(path), path)
    with _aside(path.parent, Path.mkdir) as unfinished:
        try:
            yield unfinished
            for folder, _, names in os.walk(unfinished):
                for name in names:
                    to_disk(Path(folder, name))
                to_disk(Path(folder))
        except OSError as error:
            if error.errno and error.filename is None:  # as where the disk is full
                error.filename = str(path)
            raise
        made = FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        if replace and path.exists():
            _exchange(unfinished, path)
        elif path.exists():
            raise made
        else:
            try:
                os.rename(unfinished, path)
            except OSError as error:
                raise (made if error.errno == errno.ENOTEMPTY else error) from None  # just now
    to_disk(path.parent)


@contextlib.contextmanager
def only_one(
    folder: str | Path, then: str = "wait for its end, or choose another folder"
) -> Generator[None]:
    """A context in which only this process uses a folder.

    then: what to do while another process uses it
    Raises ValueError if another process uses the folder, with its number where it is known.
    """
    try:
        lock = _locked(Path(os.path.realpath(folder)))
    except BlockingIOError:
        holder = _holder(Path(folder))
        by = "another process" if holder is None else f"process {holder}, which is running"
        raise ValueError(f"{folder} is in use by {by}; {then}") from None
    try:
        yield
    finally:
        _unlock(lock)


def remove_leftovers(folder: Path) -> None:
    """Remove the unfinished files that killed processes left in a folder.

    Files that a process is writing are kept, and so is what only has a similar name.
    """
    for left in filter(is_temporary, folder.glob(f"{UNFINISHED}*")):
        with contextlib.suppress(BlockingIOError):  # another process is writing there
            lock = _locked(left)
            if lock is not None:
                _remove(left)
                _unlock(lock)


def is_temporary(path: Path) -> bool:
    """Whether a path has a name that this module gives what is being written."""
    return _TEMPORARY.fullmatch(path.name) is not None


def to_disk(path: Path) -> None:
    """Force a file, or the names in a folder, to the disk."""
    if path.is_dir() and not hasattr(os, "O_DIRECTORY"):
        return  # this operating system cannot open folders
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _aside(folder: Path, make: Callable[[Path], object]) -> Generator[Path]:
    """A context with a new, locked temporary name in a folder.

    A file or folder that still has this name at the end is removed.
    """
    remove_leftovers(folder)
    while True:
        name = folder / f"{UNFINISHED}{os.getpid()}-{secrets.token_hex(4)}"
        make(name)
        with contextlib.suppress(BlockingIOError):  # another process is about to remove it
            lock = _locked(name)
            if name.exists():
                break
            _unlock(lock)
    try:
        yield name
    finally:
        _remove(name)
        _unlock(lock)


def _exchange(one: Path, other: Path) -> None:
    """Exchange the names of two folders in one step.

    Where a system cannot, the other one has a third name for a moment; if the process is killed
    then, the next writing of this folder gives it its name back.
    """
    if _swapped(os.fsencode(one), os.fsencode(other)):
        return
    _remove(_replaced(other))
    os.rename(other, _replaced(other))
    os.rename(one, other)
    os.rename(_replaced(other), one)


def _swapped(one: bytes, other: bytes) -> bool:
    """Whether the system has exchanged two names, as Linux and macOS can on most file systems."""
    import ctypes

    try:
        system = ctypes.CDLL(None)
        if sys.platform == "darwin":
            return system.renamex_np(one, other, 2) == 0  # RENAME_SWAP
        return system.renameat2(-100, one, -100, other, 2) == 0  # AT_FDCWD, RENAME_EXCHANGE
    except (AttributeError, OSError, TypeError):  # TypeError on Windows
        return False


def _replaced(path: Path) -> Path:
    return path.with_name(f"{UNFINISHED}replaced-{path.name}")


def _locked(path: Path) -> int | None:
    """A descriptor that locks a file or folder until it is closed; None where there are no locks.

    Raises BlockingIOError where another process, or another place in this one, holds the lock.
    """
    if fcntl is None:
        return None
    try:  # a lock on NFS needs a file open for writing; opening a pipe must not block
        access = os.O_RDONLY if path.is_dir() else os.O_RDWR
        descriptor = os.open(path, access | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            raise
        return None
    return descriptor


def _holder(path: Path) -> int | None:
    """The process that holds the lock of a file or folder, None where it cannot be told."""
    try:
        inode = path.stat().st_ino
        rows = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
        # 1: FLOCK ADVISORY WRITE 4711 08:01:1234 0 EOF
        return next(int(row[4]) for row in rows if row[5].endswith(f":{inode}"))
    except (OSError, StopIteration, ValueError, IndexError):
        return None


def _unlock(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
