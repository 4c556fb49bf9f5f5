"""Printing of pages as PDF by a browser, so that both have one source."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from uwlts.errors import SetupError
from uwlts.files.writing import write_atomically

BROWSERS = ("chromium", "chromium-headless-shell", "google-chrome", "google-chrome-stable", "msedge")
"""Names of browsers on PATH; the environment variable CHROMIUM names another one."""

_PATIENCE_S = 120.0
"""Time limit: a page with a few pictures takes 2 s, or much longer on a slow machine."""


def print_pdf(page: str, path: Path, *, overwrite: bool = False) -> None:
    """Print the text of a page as PDF, completely or not at all.

    Raises SetupError if there is no Chromium, Chrome or Edge, or it does not print; OutputError if the file exists or
    cannot be written.
    """
    browser = find_browser()
    with write_atomically(path, overwrite=overwrite) as aside, tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, encoding="utf-8", errors="replace")
        # The page is the program's own and loads nothing; root cannot use the sandbox.
        words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/profile"]
        words += ["--no-pdf-header-footer", f"--print-to-pdf={aside.absolute()}", source.as_uri()]
        try:
            done = subprocess.run([browser, *words], capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise SetupError(f"{browser} cannot print {path.name}: {error}") from error
        if not aside.stat().st_size:
            said = " ".join(done.stderr.split())[-300:]
            raise SetupError(f"{browser} has not printed {path.name} (exit status {done.returncode}): {said}")


def find_browser() -> str:
    """Return the path of the browser that prints; raises SetupError without a browser."""
    if chosen := os.environ.get("CHROMIUM"):
        if found := shutil.which(chosen):
            return found
        raise SetupError(f"the environment variable CHROMIUM names {chosen}, which is not a program")
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    raise SetupError(
        "a PDF needs Chromium, Chrome or Edge, and none is on PATH: install one (Debian: apt-get install chromium), "
        "let the environment variable CHROMIUM name one, or print the page from a browser"
    )
