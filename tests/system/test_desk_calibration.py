"""A guided calibration on the operator's page, with the twin as stage and camera."""

import re
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from tests.system.test_calibrate_live import COUNT, folder, plan, sensor, served
from tests.waiting import within
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture

if TYPE_CHECKING:
    from playwright.sync_api import Browser

__all__ = ["folder", "plan", "sensor", "served"]

pytestmark = pytest.mark.slow


def test_a_guided_calibration_is_led_through_and_calculated(plan, served, chromium: "Browser"):
    place = plan.parent
    desk = subprocess.Popen([sys.executable, "-m", "uwlts", "desk", str(place)], stdout=subprocess.PIPE, text=True)
    try:
        assert desk.stdout
        address = desk.stdout.readline().split()[1]
        page = chromium.new_page(viewport={"width": 1400, "height": 850})
        page.set_default_timeout(120_000)
        page.goto(address)
        page.get_by_role("tab", name="Calibrate").click()
        page.get_by_label("plan of the calibration").click()
        page.get_by_role("option", name="plan.toml").click()
        page.get_by_role("button", name="begin", exact=True).click()
        page.get_by_text("positions left").wait_for()
        assert [page.get_by_role("button", name=each, exact=True).is_visible() for each in ("take", "skip", "done")]
        page.locator('img[src^="coverage.png"]').wait_for()
        page.locator(".log").get_by_text("wrote calibration.json").wait_for()
        assert within(1.0, lambda: not served.controller.state().laser_on)
        found = load_calibration(place / "calibration.json")
        with Capture(place / "calibration-target.h5") as target:
            assert (~target.laser_on).sum() == COUNT
        line = page.locator(".log").get_by_text(re.compile("camera: f ")).first.inner_text()
        assert f"f {found.camera.fx_px:.2f} x" in line
        page.close()
    finally:
        desk.send_signal(signal.SIGINT)
        with desk:
            assert desk.wait(60) == 0
