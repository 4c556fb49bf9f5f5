"""Pictures of the desk's page: the twin's two spheres are scanned and measured in a real browser.

    python docs/studies/desk_pictures.py runs/inspection/calibration/calibration.json runs/desk docs/pictures

The calibration is that of docs/studies/inspection_scenes.py; the served sensor is the one that it belongs to. Needs
Chromium (`python -m tests.browser`).
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import tomli_w
from cyclopts import App
from playwright.sync_api import Page, sync_playwright

import uwlts
from tests.browser import SOFTWARE_WEBGL, find_chromium
from twin.devices.serve import serve
from twin.scene.campaign import list_takes, load_campaign

COUNT, STEP_MM = 38, 1.0
LONG_MS = 900_000


def press(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def main(calibration: Path, folder: Path, pictures: Path) -> None:
    tank = folder / "tank"
    tank.mkdir(parents=True, exist_ok=True)
    shutil.copy(calibration, tank / "calibration.json")
    campaign = {"base": "thesis", "title": "desk", "recordings": [{"scene": "spheres", "placements": ["standoff"]}]}
    (folder / "desk.toml").write_text(tomli_w.dumps(campaign), encoding="utf-8")
    (take,) = list_takes(load_campaign(folder / "desk.toml"), seed=0)
    with serve(take.scene, sensor=take.sensor, as_built=take.built, spp=8, speed_up=50.0) as served:
        plan = {"title": "Spheres", "sensor": "thesis", "medium": "water", "camera": served.camera.address}
        start = served.track.start_mm + take.scene.motion.start_mm - min(take.scene.motion.start_mm, 0.0)
        stage = {"port": served.controller.port, "start_mm": start, "step_mm": STEP_MM, "count": COUNT}
        plan |= {"stage": stage | {"feed_mm_per_min": 900.0}, "artefact": take.scene.artefact}
        (tank / "plan.toml").write_text(tomli_w.dumps(plan), encoding="utf-8")
        words = ["desk", str(tank), "--plan", str(tank / "plan.toml"), "--port", "18400"]
        running = subprocess.Popen([sys.executable, "-m", "uwlts", *words], stdout=subprocess.PIPE, text=True)
        try:
            assert running.stdout
            found = re.search(r"open (\S+) to work", running.stdout.readline())
            assert found
            with sync_playwright() as started:
                browser = started.chromium.launch(executable_path=str(find_chromium()), args=list(SOFTWARE_WEBGL))
                page = browser.new_page(viewport={"width": 1400, "height": 850})
                page.set_default_timeout(LONG_MS)
                page.goto(found[1])
                drive(page, tank, pictures)
                browser.close()
        finally:
            running.terminate()
            running.wait(60)


def drive(page: Page, tank: Path, pictures: Path) -> None:
    """Connect, scan, reconstruct, measure with limits, cut a section, and take the pictures."""
    press(page, "connect")
    tab(page, "Stage")
    page.locator(".log").get_by_text("connected: Grbl").wait_for()
    press(page, "home")
    page.locator(".log").get_by_text("homing done").wait_for()
    tab(page, "Scan")
    page.get_by_label("calibration for the cloud").click()
    page.get_by_role("option", name="calibration.json").click()
    press(page, "start")
    page.get_by_text(re.compile(f"recording, 3[0-9] of {COUNT}")).wait_for()
    press(page, "fit")
    page.wait_for_timeout(1500)
    page.screenshot(path=pictures / "desk-scan.png")
    page.locator(".log").get_by_text(re.compile(r"wrote .*\.h5")).wait_for()
    tab(page, "Files")
    press(page, "reconstruct")
    page.locator(".log").get_by_text(re.compile(r"wrote .*\.cloud\.h5")).wait_for()
    cloud = uwlts.read(next(tank.glob("*.cloud.h5")))
    page.locator(f'.cloud-view[data-points="{len(cloud)}"]').wait_for()
    press(page, "fit")
    page.wait_for_timeout(1500)
    tab(page, "Measure")
    page.get_by_label("radius about the point, mm").fill("30")
    box = page.locator(".cloud-view canvas").first.bounding_box()
    assert box
    for side in (0.22, 0.76):
        for v in np.linspace(0.45, 0.7, 26):
            before = page.locator(".tools").inner_text()
            page.mouse.click(box["x"] + box["width"] * side, box["y"] + box["height"] * float(v))
            page.wait_for_timeout(400)
            if page.locator(".tools").inner_text() != before:
                break
        press(page, "sphere")
        page.wait_for_timeout(5000)
    press(page, "length")
    rows = page.locator(".measured")
    rows.get_by_text("distance").wait_for()
    for row in reversed(rows.filter(has_text="standard deviation").all()):
        row.get_by_role("button", name="remove").click()
        page.wait_for_timeout(1000)
    for sphere in range(2):
        for label, limit in (("lower, mm", "50.0"), ("upper, mm", "50.2")):
            page.get_by_label(label).nth(sphere).fill(limit)
            page.keyboard.press("Tab")
    page.wait_for_timeout(3000)
    page.screenshot(path=pictures / "desk-measure.png")
    press(page, "section")
    page.locator(".plot").wait_for()
    page.wait_for_timeout(2000)
    page.screenshot(path=pictures / "desk-section.png")


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
