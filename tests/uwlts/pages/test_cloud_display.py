"""Views of clouds: in frames of one page, as notebooks show them, and from scripts in the browser."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from uwlts.errors import ArgumentError
from uwlts.pages.cloud_display import MOST_SHOWN, choose_points, display_points
from uwlts.storage.cloud import PointCloud

COUNT = 3000


def ramp(count: int = COUNT) -> PointCloud:
    """Points on a slope: Z from 300 to 340 mm, grey values from 0 to 200, standard deviations from 10 to 30 um."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-50, 50, (2, count))
    along = (x + 50) / 100
    points, none = np.column_stack([x, y, 300 + 40 * along]), np.full(count, -1)
    return PointCloud(points, 200 * along, none, none, common_std_mm=0.01 + 0.02 * along)


def test_several_views_draw_in_frames_of_one_page_without_the_network(tmp_path: Path, chromium):
    cloud, fields = ramp(), ("depth", "common", "intensity")
    displays = [display_points(cloud.points_mm, field, cloud.field_values(field)) for field in fields]
    frames = "".join(each._repr_html_() for each in displays)
    assert frames.count('sandbox="allow-scripts"') == len(fields)
    (tmp_path / "notebook.html").write_text(f"<!DOCTYPE html><meta charset='utf-8'>{frames}", encoding="utf-8")
    context = chromium.new_context(viewport={"width": 900, "height": 2000}, offline=True)
    shown, said = context.new_page(), []
    shown.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.goto((tmp_path / "notebook.html").as_uri())
    # The scale ends at the 1st and 99th percentile: 98 % of the range of each.
    for number, (unit, low, high) in enumerate((("mm", 300, 340), ("µm", 10, 30), ("grey values", 0, 200))):
        frame = shown.frame_locator("iframe").nth(number)
        view = frame.locator(f'.cloud-view[data-points="{COUNT}"]')
        view.wait_for()
        assert frame.locator(".legend b").inner_text() == f"{fields[number]}, {unit}"
        ends = [float(text) for text in frame.locator(".legend span").all_inner_texts()]
        # 30 points are beyond each percentile, give or take 4 standard deviations of 5.4.
        assert ends == pytest.approx([high - 0.01 * (high - low), low + 0.01 * (high - low)], abs=0.01 * (high - low))
        assert frame.locator("figcaption").inner_text().startswith("All 3,000 points.")
        pixels = cv2.imdecode(np.frombuffer(view.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert (pixels.max(axis=2) > 100).sum() > COUNT
    assert not said
    context.close()


@pytest.mark.parametrize("installed", [True, False], ids=["browser", "no browser"])
def test_a_script_writes_a_page_and_opens_it(tmp_path: Path, installed: bool):
    ramp(50).save(tmp_path / "a.ply")
    (tmp_path / "temporary").mkdir()
    opened = tmp_path / "opened.txt"
    (tmp_path / "browser").write_text(f'#!/bin/sh\necho "$1" > "{opened}"\n', encoding="utf-8")
    (tmp_path / "browser").chmod(0o755)
    # Without PATH and display Python finds no browser.
    found = {"BROWSER": str(tmp_path / "browser")} if installed else {"BROWSER": "", "PATH": "", "DISPLAY": ""}
    code = "import uwlts; uwlts.read('a.ply').show()"
    environment = os.environ | found | {"TMPDIR": str(tmp_path / "temporary")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    (page,) = (tmp_path / "temporary").glob("uwlts-*/cloud.html")
    assert done.stdout.startswith(f"point cloud: {page}") and ("no browser was found" in done.stdout) != installed
    assert not installed or opened.read_text().strip() == page.as_uri()
    (stored,) = re.findall(r'<script type="application/json" id="cloud-0">([^<]*)', page.read_text(encoding="utf-8"))
    assert json.loads(stored)["count"] == 50


def test_large_clouds_are_sampled_and_unknown_values_stay_unknown():
    points = np.random.default_rng(5).normal(size=(MOST_SHOWN + 100, 3))
    chosen, caption = choose_points(points, "random", None, most=MOST_SHOWN)
    assert len(chosen.points_mm) == MOST_SHOWN and chosen.values is not None and np.isnan(chosen.values).all()
    assert caption.startswith("200,000 of 200,100 points, drawn at random.")


def test_another_colour_is_refused():
    with pytest.raises(ArgumentError, match="`colour` is 'red'.*'depth', 'intensity', 'random' or 'common'"):
        ramp(3).show("red")  # pyright: ignore[reportArgumentType]
