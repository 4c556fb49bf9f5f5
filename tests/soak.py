"""Soak test, a long scan from the operator's page: ``python -m tests.soak [images]``, 100,000 images by default.

Camera and controller speak their real protocols. The camera sends drawn stripes, since rendering would take days. A
headless browser shows the page during the scan. After each tenth of the scan, a line states the rate and the memory of
desk and browser. The exit status is 1 if either memory grew by more than a quarter after the first fifth, or an image
is missing.
"""

import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

import uwlts
from tests.browser import find_chromium, open_chromium
from tests.system.drawn_hardware import RESOLUTION_MM, STAGE, DrawnCamera, write_plan
from twin.devices.grbl_controller import GrblController
from uwlts.storage.capture import Capture

if TYPE_CHECKING:
    from playwright.sync_api import Page

GROWTH = 1.25
SPEED_UP = 500.0


def memory_mib(process: int) -> float:
    """Memory in use by a process and its children, MiB."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    status = Path(f"/proc/{process}/status").read_text()
    own = int(re.findall(r"VmRSS:\s+(\d+)", status)[0]) / 1024
    return own + sum(memory_mib(int(child)) for child in children)


def heap_mib(page: "Page") -> float:
    """Return the memory of the page's scripts after garbage collection, MiB."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")["usedSize"] / 2**20
    session.detach()
    return used


def main(images: int = 100_000) -> int:
    """Run the soak test and return the exit status."""
    with tempfile.TemporaryDirectory() as place:
        return _soak(Path(place), images)


def _soak(folder: Path, images: int) -> int:
    with GrblController(settings=STAGE, speed_up=SPEED_UP) as controller, DrawnCamera(controller) as camera:
        plan = write_plan(folder, camera, controller, count=images, step_mm=RESOLUTION_MM)
        uwlts.nominal(folder / "sensor.toml", medium="air").save(folder / "nominal.json")
        desk = subprocess.Popen(
            [sys.executable, "-m", "uwlts", "desk", str(folder), "--plan", str(plan)], stdout=subprocess.PIPE, text=True
        )
        try:
            address = (desk.stdout.readline() if desk.stdout else "").split()[1]
            with open_chromium(find_chromium()) as browser:
                page = browser.new_page()
                page.goto(address)
                _begin(page)
                return _watched(page, desk.pid, folder, images)
        finally:
            desk.send_signal(signal.SIGINT)
            desk.wait(60)


def _begin(page: "Page") -> None:
    def press(name: str) -> None:
        page.get_by_role("button", name=name, exact=True).click()

    press("connect")
    page.get_by_role("tab", name="Stage").click()
    press("home")
    page.get_by_text("homing done").wait_for(timeout=60_000)
    page.get_by_role("tab", name="Scan").click()
    page.get_by_label("calibration for the cloud").click()
    page.get_by_role("option", name="nominal.json").click()
    press("start")


def _watched(page: "Page", desk: int, folder: Path, images: int) -> int:
    began, measured = time.monotonic(), []
    print(f"{'images':>8} {'images/s':>9} {'desk/MiB':>9} {'page/MiB':>9}", flush=True)
    for tenth in range(1, 11):
        wanted = images * tenth // 10
        while (done := _done(page)) < wanted and not (folder / "scan.h5").exists():
            time.sleep(0.2)
        done = min(done, images)
        measured.append((memory_mib(desk), heap_mib(page)))
        rate = done / (time.monotonic() - began)
        print(f"{done:8d} {rate:9.1f} {measured[-1][0]:9.0f} {measured[-1][1]:9.1f}", flush=True)
    page.get_by_text("wrote scan.h5").first.wait_for(timeout=60_000)
    with Capture(folder / "scan.h5") as capture:
        complete = len(capture) == images
    grown = [last / first for first, last in zip(measured[1], measured[-1], strict=True)]
    print(f"grown by {grown[0]:.2f} (desk) and {grown[1]:.2f} (page) since a fifth of the way; complete: {complete}")
    return int(not complete or max(grown) > GROWTH)


def _done(page: "Page") -> int:
    found = re.search(r"(\d+) of \d+", page.locator("header").inner_text())
    return int(found[1]) if found else 0


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
