"""This module records every state of a folder that a killed process could leave behind.

It copies the folder before each operation in it. Python reports each file that is opened, each
folder that is made and each name that is changed before it happens (`sys.addaudithook`). For a file
that was opened for writing, two copies are taken: one without its content, and one with half of
what was written by the time of the next event. Equal states are kept once.
"""

import hashlib
import os
import shutil
import sys
import threading
from contextlib import contextmanager

CHANGES = {
    "os.mkdir": 0,
    "os.rename": 0,
    "os.remove": 0,
    "os.rmdir": 0,
    "os.link": 0,
    "os.truncate": 0,
}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Recorder:
    """The recorder copies the states of a folder.

    snapshots: folders, each a state of `root`, in order.
    """

    def __init__(self, root, kept):
        self.root, self.kept, self.snapshots = str(root), kept, []
        self.seen, self.written, self.lock, self.busy = (
            set(),
            None,
            threading.Lock(),
            threading.local(),
        )

    def __call__(self, event, arguments):
        if getattr(self.busy, "now", False):
            return
        opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITING
        if not (opened or event in CHANGES) or not str(arguments[0]).startswith(self.root):
            return
        with self.lock:
            self.busy.now = True
            try:
                self.copy()
                if self.written and os.path.isfile(self.written):
                    size = os.path.getsize(self.written)
                    for part in (0, size // 2):
                        self.copy(cut=(os.path.relpath(self.written, self.root), part))
                self.written = str(arguments[0]) if opened else None
            finally:
                self.busy.now = False

    def copy(self, cut=None):
        folder = self.kept / f"{len(self.snapshots):04d}"
        shutil.copytree(self.root, folder, dirs_exist_ok=True)
        if cut is not None:
            os.truncate(folder / cut[0], cut[1])
        state = hashlib.sha256()
        for path in sorted(folder.rglob("*")):
            state.update(
                str(path.relative_to(folder)).encode()
                + (path.read_bytes() if path.is_file() else b"/")
            )
        if state.digest() in self.seen:
            shutil.rmtree(folder)
        else:
            self.seen.add(state.digest())
            self.snapshots.append(folder)


_recording = []


def _hook(event, arguments):
    if _recording:
        _recording[-1](event, arguments)


@contextmanager
def recorded(root, kept):
    """Record the states that `root` goes through within the block, as folders in `kept`."""
    if not getattr(sys, "_crash_points", False):
        sys._crash_points = True
        sys.addaudithook(_hook)  # stays until the process ends, since a hook cannot be removed
    root.mkdir()
    recorder = Recorder(root, kept)
    _recording.append(recorder)
    try:
        yield recorder.snapshots
    finally:
        _recording.pop()
        recorder.busy.now = True
        recorder.copy()
        recorder.busy.now = False
