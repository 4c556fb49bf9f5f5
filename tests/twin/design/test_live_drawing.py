"""The live drawing of the documentation shows the figures of the design formulas."""

import importlib.util
from pathlib import Path

import pytest

import uwlts

FILE = Path(__file__).resolve().parents[3] / "docs/tutorials/live_drawing.py"


def test_view_and_resolution_are_those_of_the_formulas():
    described = importlib.util.spec_from_file_location("live_drawing", FILE)
    assert described and described.loader
    live = importlib.util.module_from_spec(described)
    described.loader.exec_module(live)
    sensor = live.variant(uwlts.load_sensor("thesis"), 250.0, 40.0)
    rows = {row.name: row.value for row in uwlts.design(sensor, medium="water")}
    assert live.standoff(sensor, "water") == pytest.approx(rows["stand-off from the pupil"])
    side, resolution = live.draw(sensor, "water")
    written = {text.get_text() for text in side.axes[0].texts}
    assert {"baseline 250 mm", "40°", f"stand-off {rows['stand-off from the window']:.1f} mm"} <= written
    far, near = resolution.axes[0].get_ylim()
    outer = rows["stand-off from the pupil"] - rows["stand-off from the window"]
    assert near - outer == pytest.approx(rows["sheet in view, nearest to the window"])
    assert far - outer == pytest.approx(rows["sheet in view, farthest from the window"])
    # The depth per pixel grows nearly in proportion to the square of the depth, and the map is of the whole depth.
    levels = resolution.axes[0].collections[0]
    at_standoff = 1e3 * rows["depth per pixel at the stand-off"]
    for depth, value in ((near, levels.zmin), (far, levels.zmax)):
        assert value == pytest.approx(at_standoff * (depth / rows["stand-off from the pupil"]) ** 2, rel=0.1)
