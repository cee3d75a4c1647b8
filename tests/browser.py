"""A browser that tests drive: its place, what it shows of a page, and what a page says in it."""

import contextlib
import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib import image

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
HEADLESS = (
    *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-quic"),
)
# Wheels cannot hold a browser, so the pinned versions do not give it.
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs a browser: install the system's package chromium"
)


def seen(page, folder, *options):
    """Let a browser open a page and end; return what it prints."""
    command = [*HEADLESS, f"--user-data-dir={folder / 'profile'}", *options, page.as_uri()]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout


def photographed(page, folder):
    """Return what a browser shows of a page, (rows, columns, 3) in 0..255."""
    shot = folder / "shot.png"
    seen(page, folder, "--window-size=900,1400", f"--screenshot={shot}")
    return np.round(255 * image.imread(shot)[:, :, :3]).astype(int)


@contextlib.contextmanager
def looking_at(address, folder, *options):
    """A context in which a browser has a page open."""
    profile = f"--user-data-dir={folder / 'profile'}"
    debugging = "--remote-debugging-port=0"  # keeps the browser open
    with subprocess.Popen(
        [*HEADLESS, *options, profile, debugging, address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as browser:
        try:
            yield
        finally:
            browser.terminate()


def opened(page, folder, script):
    """Return what a script of a page says in a browser; it is run 3 s after the page is there.

    script: statements that return a value
    """
    text = page.read_text(encoding="utf-8")
    asking = (
        "<script>setTimeout(async () => { let said; try { said = await (async () => {"
        f"{script}"
        "})() } catch (error) { said = String(error) }"
        "document.title = 'said:' + JSON.stringify(said); }, 3000)</script></body>"
    )
    body, _, end = text.rpartition("</body>")  # the library has this text, too
    (folder / "asked.html").write_text(body + asking + end, encoding="utf-8")
    found = seen(folder / "asked.html", folder, "--dump-dom", "--virtual-time-budget=8000")
    said = html.unescape(re.search(r"<title>said:(.*?)</title>", found, re.DOTALL).group(1))
    return json.loads(said)
