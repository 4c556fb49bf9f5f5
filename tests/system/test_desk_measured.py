"""Measurements on the operator's page: clicks in the cloud and in a section, the list with limits, undo, its files."""

import csv
import json
import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests import preloaded
from tests.system.test_desk import SLOW_MS, press, says, tab, watched
from tests.system.test_desk_analyses import choose
from tests.uwlts.desk.test_analyses import HEIGHT_MM, NOISE_MM, step_cloud, weld_cloud
from uwlts.storage.cloud import PointUncertainty

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

COMMON_MM = 0.003
"""Standard deviation of an error in Z common to all points."""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Folder with a cloud of a step, with uncertainty."""
    cloud = step_cloud()
    random = np.zeros((len(cloud), 6), np.float32)
    random[:, 5] = NOISE_MM**2
    none = np.zeros((len(cloud), 3), np.float32)
    known = PointUncertainty(random, none, np.full((1, len(cloud), 3), [0, 0, COMMON_MM], np.float32))
    replace(cloud, uncertainty=known).save(tmp_path / "plate.cloud.h5")
    return tmp_path


@pytest.fixture
def page(place: Path, chromium: "Browser") -> "Iterator[Page]":
    desk = preloaded.uwlts("desk", str(place), "--port", "0")
    try:
        address = desk.stdout.readline().split()[1]
        with watched(chromium.new_page(viewport={"width": 1280, "height": 800})) as opened:
            opened.set_default_timeout(SLOW_MS)
            opened.goto(address)
            yield opened
    finally:
        desk.send_signal(signal.SIGINT)
        desk.communicate()
    assert desk.poll() == 0


def pick(page: "Page", share: float, before: str) -> str:
    """Click a point of the cloud at a share of the width; return the picked places."""
    places = page.locator(".tools .whitespace-pre-wrap").first
    box = page.locator(".cloud-view canvas").first.bounding_box()
    assert box
    for v in np.linspace(0.47, 0.53, 13):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + float(v) * box["height"])
        page.wait_for_timeout(200)
        if (text := places.inner_text()) != before:
            return text
    raise AssertionError("no point is under the clicks")


def rows(page: "Page") -> list[str]:
    return [each.inner_text() for each in page.locator(".measured").all()]


def test_values_are_measured_limited_undone_and_saved(page, place):
    tab(page, "Files")
    press(page, "show")
    page.locator('.cloud-view[data-points="2400"]').wait_for()
    tab(page, "Measure")
    press(page, "section")
    says(page, "error: click two points")
    # One on each face, across the step.
    text = pick(page, 0.7, pick(page, 0.25, "no point is picked"))
    places = np.array(re.findall(r"X (\S+) +Y (\S+) +Z (\S+) mm", text), float)
    assert abs(abs(places[0, 2] - places[1, 2]) - HEIGHT_MM) < 1.0
    press(page, "length")
    row = page.locator(".measured")
    row.get_by_text("distance").wait_for()
    length, half = map(float, re.search(r"distance ([\d.]+) ± ([\d.]+) mm", rows(page)[0]).groups())
    assert length == pytest.approx(np.linalg.norm(places[1] - places[0]), abs=0.01) and 0 < half < 4 * NOISE_MM
    # A step in the section through both, by clicks in the plot at 20 % and 80 % of its axes.
    page.get_by_label("width, mm").fill("6")
    press(page, "section")
    plot = page.locator(".plot")
    plot.wait_for()
    box = plot.bounding_box()
    for share in (0.35, 0.8):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + box["height"] / 2)
        page.wait_for_timeout(300)
    press(page, "step")
    page.get_by_text(re.compile(r"section: step: height [\d.]+ ±")).wait_for()
    press(page, "keep")
    row.nth(1).wait_for()
    height, half = map(float, re.search(r"height ([\d.]+) ± ([\d.]+) mm", rows(page)[1]).groups())
    # Four standard uncertainties, whose random part is of eight draws. The second place is on the nearer face.
    assert abs(height - HEIGHT_MM) < 2 * half and half < 1.0
    for lower, upper, verdict in (("0", "20", "within"), ("", "", "no limit"), ("15", "", "exceeds")):
        for label, limit in (("lower, mm", lower), ("upper, mm", upper)):
            page.get_by_label(label).nth(1).fill(limit)
            page.keyboard.press("Tab")
        row.nth(1).get_by_text(re.compile(f"^{verdict}")).wait_for()
    # A refresh of the list after the last change keeps the text that the user types meanwhile.
    upper = page.get_by_label("upper, mm").nth(1)
    upper.fill("20")
    page.keyboard.press("Tab")
    upper.fill("")
    page.wait_for_timeout(500)
    assert upper.input_value() == ""
    page.keyboard.press("Tab")
    # A wrong limit is refused, and the row shows the limits that hold.
    page.get_by_label("lower, mm").nth(0).fill("9")
    page.keyboard.press("Tab")
    page.get_by_label("upper, mm").nth(0).fill("1")
    page.keyboard.press("Tab")
    says(page, "the lower limit 9 mm is above the upper one")
    page.wait_for_function("document.querySelectorAll('[aria-label=\"upper, mm\"]')[0].value === ''")
    page.get_by_label("name", exact=True).nth(0).fill("plate, across")
    page.keyboard.press("Tab")
    # Removed, and both changes undone by one press each.
    press(page, "save the list")
    says(page, "wrote plate.measured.html, plate.measured.json, plate.measured.csv")
    row.nth(0).get_by_role("button", name="remove").click()
    page.wait_for_function("document.querySelectorAll('.measured').length === 1")
    press(page, "undo")
    page.wait_for_function("document.querySelectorAll('.measured').length === 2")
    assert page.get_by_label("name", exact=True).nth(0).input_value() == "plate, across"
    press(page, "undo")
    page.wait_for_function("document.querySelectorAll('[aria-label=\"name\"]')[0].value === 'length 1'")
    # The list belongs to the desk, not to the browser.
    page.reload()
    tab(page, "Measure")
    row.nth(1).wait_for()
    with (place / "plate.measured.csv").open(encoding="utf-8", newline="") as file:
        kept = list(csv.DictReader(file))
    assert [each["name"] for each in kept] == ["plate, across", "step 1"]
    assert [each["quantity"] for each in kept] == ["distance", "height"]
    assert float(kept[1]["value_mm"]) == pytest.approx(height, abs=half)
    tab(page, "Files")
    press(page, "list")
    says(page, "plate.measured.json: 2 values")
    tab(page, "Measure")
    page.wait_for_function("document.querySelectorAll('[aria-label=\"name\"]')[0].value === 'plate, across'")
    # The list appears in the report of an inspection.
    weld_cloud().save(place / "weld.ply")
    tab(page, "Inspect")
    choose(page, "analysis", "inspect weld")
    choose(page, "cloud", "weld.ply")
    choose(page, "measured values", "plate.measured.json")
    press(page, "analyse")
    says(page, "wrote weld-weld.html")
    assert "plate, across" in (place / "weld-weld.html").read_text(encoding="utf-8")
    record = json.loads((place / "weld-weld.findings.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in record["measured"]] == ["plate, across", "step 1"]


def test_a_histogram_has_the_field_s_axis(page):
    tab(page, "Files")
    press(page, "show")
    page.locator('.cloud-view[data-points="2400"]').wait_for()
    tab(page, "Measure")
    press(page, "histogram")
    page.get_by_text(re.compile(r"Z: mean 393\.7\d+, standard deviation 6\.2\d+ mm, 2,400 points")).wait_for()
    shown = page.locator(".plot text").all_text_contents()
    assert {"390", "395", "400", "Z / mm", "points"} <= set(shown)
    choose(page, "field", "deviation")
    press(page, "histogram")
    says(page, "the cloud has no deviation: choose another field")
    press(page, "live profile")
    says(page, "there is no profile yet: choose the calibration under Scan")
