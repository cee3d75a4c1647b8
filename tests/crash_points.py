"""This module records every state of a folder that a killed process could leave behind.

It copies the folder before each operation in it. Python reports each file that is opened, each
folder that is made and each name that is changed before it happens (`sys.addaudithook`). For a file
that was opened for writing, two copies are taken: one without its content, and one with half of
what was written by the time of the next event. Equal states are kept once.
"""

import hashlib
import os
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Recorder:
    """What copies the states of a folder `root`, in order, to the folders `snapshots`."""

    def __init__(self, root, kept):
        self.root, self.kept, self.snapshots = root, kept, []
        self.seen, self.written = set(), None
        self.lock, self.busy = threading.Lock(), threading.local()

    def __call__(self, event, arguments):
        if getattr(self.busy, "now", False):
            return
        opened = event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITING
        if not (opened or event in CHANGES) or not str(arguments[0]).startswith(str(self.root)):
            return
        with self.lock:
            self.busy.now = True
            try:
                self.keep(state := self.state())
                if (content := state.get(self.written)) is not None:
                    for part in (0, len(content) // 2):
                        self.keep(state | {self.written: content[:part]})
                self.written = Path(os.fsdecode(arguments[0])) if opened else None
            finally:
                self.busy.now = False

    def state(self):
        """Return {path: content, None of a folder} of all in `root`, at one moment.

        Other threads go on until their next event. What two readings find alike was so from the
        end of the first to the start of the second.
        """
        before = None
        while True:
            try:
                now = {
                    path: None if path.is_dir() else path.read_bytes()
                    for path in sorted(self.root.rglob("*"))
                }
            except FileNotFoundError:  # another thread has renamed or removed it
                now = None
            if now is not None and now == before:
                return now
            before = now

    def keep(self, state):
        digest = hashlib.sha256(repr(state).encode()).digest()
        if digest in self.seen:
            return
        self.seen.add(digest)
        folder = self.kept / f"{len(self.snapshots):04d}"
        folder.mkdir()
        for path, content in state.items():
            copy = folder / path.relative_to(self.root)
            copy.mkdir() if content is None else copy.write_bytes(content)
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
        recorder.keep(recorder.state())
        recorder.busy.now = False
