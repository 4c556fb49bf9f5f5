"""The operator's page on a desktop, a tablet and a phone: everything in sight, keys in order."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.system.test_desk import (
    DESCRIPTIONS,
    TABS,
    LaserOff,
    desk,
    press,
    says,
    served,
    shows,
    sized,
    start_scan,
    tab,
)
from tests.system.test_desk_analyses import choose
from tests.uwlts.desk.test_analyses import step_cloud, weld_cloud
from tests.waiting import within

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from twin.devices.serve import ServedTwin

__all__ = ["DESCRIPTIONS", "desk", "served", "sized"]

pytestmark = pytest.mark.slow

FINGER_PX = 44
"""Least size of a target for a finger: WCAG 2.2, success criterion 2.5.5."""
LAYOUT = """() => {
  const box = (e) => { const b = e.getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; };
  const parts = ["image", "cloud", "tools", "log", "legend", "scale", "axes"]
    .map((name) => [name, box(document.querySelector(`.${name}`))]);
  const seen = [...document.querySelectorAll(".desk button, .desk [role=tab], .desk a, .desk [role=checkbox]")]
    .filter((e) => e.offsetParent !== null).map((e) => [e.innerText || e.ariaLabel, ...box(e)]);
  const { scrollWidth, scrollHeight } = document.documentElement;
  return { parts: Object.fromEntries(parts), seen, over: [scrollWidth - innerWidth, scrollHeight - innerHeight] };
}"""


def test_controls_are_in_sight_and_large_enough_for_a_finger(desk, sized):
    page = sized
    step_cloud().save(desk.folder / "plate.ply")
    tab(page, "Files")
    page.get_by_role("button", name="show", exact=True).click()
    page.locator(".cloud-view .legend").wait_for()
    checked = 0
    for name in TABS:
        tab(page, name)
        page.wait_for_function(
            "n => document.querySelector('[role=tab][aria-selected=true]').innerText === n", arg=name
        )
        page.wait_for_timeout(500)
        found = page.evaluate(LAYOUT)
        parts = found["parts"]
        assert max(found["over"]) <= 0, name
        assert parts["image"][1::2] == pytest.approx(parts["cloud"][1::2], abs=1), name
        assert parts["cloud"][3] - parts["cloud"][1] >= 150
        # Neither hides the other: legend above scale bar, axes beside it.
        assert parts["legend"][3] <= parts["scale"][1] and parts["axes"][2] <= parts["scale"][0]
        for label, left, top, right, bottom in found["seen"]:
            if page.viewport_size["width"] < 1000:
                assert right - left >= FINGER_PX - 0.5 and bottom - top >= FINGER_PX - 0.5, (name, label)
            assert left >= 0 and right <= page.viewport_size["width"] and top >= 0, (name, label)
            assert bottom <= page.viewport_size["height"], (name, label)
            checked += 1
    assert checked > 60


def focused(page: "Page") -> str:
    return (
        page.evaluate("(e => e.ariaLabel || e.innerText || e.labels?.[0]?.innerText || '')(document.activeElement)")
        .strip()
        .lower()
    )


def test_the_tab_key_goes_from_laser_off_through_view_and_controls_to_the_log(desk, sized):
    page = sized
    page.get_by_role("button", name="connect", exact=True).wait_for()
    page.wait_for_timeout(1500)
    page.locator("#laser-off").focus()
    names = [focused(page)]
    while names[-1] != "log" and len(names) < 40:
        page.keyboard.press("Tab")
        names.append(focused(page))
    wanted = ["laser off", "point cloud", "colour", "fit", "connect", "plan of the scan", "camera", "stage", "connect"]
    wanted += ["exposure, ms", "log"]
    remaining = iter(names)
    assert all(any(name.startswith(word) for name in remaining) for word in wanted), names
    # Every stop has a name, and none comes twice in a row.
    assert all(names) and all(a != b for a, b in pairwise(names)), names


GUIDED = """
title = "Target"
sensor = "sensor.toml"
camera = "{camera}"
[target]
kind = "circles"
spacing_x_mm = 12.0
spacing_y_mm = 12.0
diameter_mm = 7.0
marker_diameter_mm = 3.0
columns = 15
rows = 13
origin = [7, 6]
marker_x = [1, 0]
marker_y = [0, 1]
[stage]
port = "{port}"
"""


def write_large_weld(path: Path) -> None:
    """Write a cloud whose inspection takes a while."""
    cloud = weld_cloud()
    shifts = [(x, y, 0.0) for x in np.arange(0, 1, 0.1) for y in np.arange(0, 1, 0.1)]
    points = np.concatenate([cloud.points_mm + shift for shift in shifts])
    columns = {name: np.tile(getattr(cloud, name), len(shifts)) for name in ("intensity", "frame", "line")}
    replace(cloud, points_mm=points, **columns).save(path)


def unlock(page: "Page") -> None:
    """Accept the stage's position, as after Laser off."""
    shows(page, "has to be homed")
    tab(page, "Stage")
    press(page, "unlock")
    shows(page, "ready")


def show_laser(page: "Page", *, reload: bool = False) -> None:
    """Show live images with the laser, which the guard ends if the machine is too busy: then show them again."""
    for _ in range(5):
        unlock(page)
        tab(page, "Connect")
        press(page, "laser")
        page.wait_for_timeout(2000)
        if reload:
            page.reload()
            page.get_by_role("tab", name="Connect").wait_for()
        header = page.locator("header").filter(has_text=re.compile("laser ON for images|has to be homed"))
        header.wait_for()
        if "laser ON for images" in header.inner_text():
            return
    raise AssertionError("live images with the laser do not last")


def test_laser_off_works_in_every_phase(desk, sized: "Page", served: "ServedTwin"):
    """Judged by the controller's light; in homing, when the laser cannot be on, by the controller's state."""
    page, folder, firmware = sized, desk.folder, served.controller._firmware
    off = LaserOff(page, served)
    write_large_weld(folder / "plate.ply")
    text = GUIDED.format(camera=served.camera.address, port=served.controller.port)
    (folder / "guided.toml").write_text(text, encoding="utf-8")
    press(page, "connect")
    says(page, "connected: Grbl")
    # Homing, whose movement is blocked until the controller is reset.
    served.controller.inject("stall")
    tab(page, "Stage")
    press(page, "home")
    shows(page, "homing")
    assert within(20.0, lambda: firmware._mode == "Home")
    off.press("homing")
    assert within(5.0, lambda: firmware._mode == "Alarm")
    shows(page, "has to be homed")
    press(page, "home")
    says(page, "homing done")
    tab(page, "Connect")
    press(page, "lamp")
    page.locator(".image").get_by_text(re.compile("^live, lamp")).wait_for()
    off.works("live-lamp")
    show_laser(page)
    off.ends_flashes("live-laser")
    show_laser(page, reload=True)
    off.ends_flashes("live-laser-reloaded")
    unlock(page)
    start_scan(page)
    off.ends_flashes("scanning")
    unlock(page)
    tab(page, "Scan")
    press(page, "continue interrupted")
    shows(page, "of 60")
    press(page, "pause")
    says(page, "paused, the laser is off")
    off.works("paused")
    unlock(page)
    tab(page, "Inspect")
    choose(page, "analysis", "inspect weld")
    choose(page, "cloud", "plate.ply")
    press(page, "analyse")
    page.get_by_text(re.compile(r"inspect weld: plate.ply, \d+ s")).wait_for()
    off.works("analysis")
    assert page.get_by_text(re.compile(r"inspect weld: plate.ply, \d+ s")).is_visible()
    press(page, "cancel")
    page.get_by_role("alert").get_by_text("cancelled").wait_for()
    # A plot, and a note about an error.
    tab(page, "Files")
    page.get_by_role("button", name="show", exact=True).click()
    page.locator(".cloud-view .legend").wait_for()
    tab(page, "Measure")
    press(page, "histogram")
    page.locator(".plot").wait_for()
    press(page, "length")
    page.get_by_role("alert").get_by_text("click two points").wait_for()
    off.works("measuring")
    tab(page, "Calibrate")
    page.get_by_label("plan of the calibration").click()
    page.get_by_role("option", name="guided.toml").click()
    press(page, "begin")
    page.get_by_role("button", name="take", exact=True).wait_for()
    off.works("guided")
    # This light has not been the calibration's, which ends all the same.
    says(page, "which ends the calibration")
    shows(page, "not connected")
    assert len(off.states) == 9
