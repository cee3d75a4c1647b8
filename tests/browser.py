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
SILENT = (
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
)
# Wheels cannot hold a browser, so the pinned versions do not give it.
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="needs a browser: install the system's package chromium"
)


def photographed(page, folder):
    """Return what a browser shows of a page, (rows, columns, 3) in 0..255."""
    shot = folder / "shot.png"
    command = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        *SILENT,
        f"--user-data-dir={folder / 'profile'}",
    ]
    subprocess.run(
        [*command, "--window-size=900,1400", f"--screenshot={shot}", page.as_uri()],
        check=True,
        capture_output=True,
        timeout=60,
    )
    return np.round(255 * image.imread(shot)[:, :, :3]).astype(int)


@contextlib.contextmanager
def looking_at(address, folder, *options):
    """A context in which a browser has a page open."""
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", *SILENT, *options]
    profile = f"--user-data-dir={folder / 'profile'}"
    debugging = "--remote-debugging-port=0"  # keeps the browser open
    with subprocess.Popen(
        [*command, profile, debugging, address],
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
    found = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"),
            *(f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=8000"),
            (folder / "asked.html").as_uri(),
        ],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    ).stdout
    said = html.unescape(re.search(r"<title>said:(.*?)</title>", found, re.DOTALL).group(1))
    return json.loads(said)
