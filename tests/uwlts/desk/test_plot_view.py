"""Plots of the page: round ticks, and clicks at the places that are drawn."""

import re

import numpy as np
import pytest

from uwlts.desk.measure_panel import Plot, ticks


@pytest.mark.parametrize("low, high", [(0.0, 1.0), (-0.05, 0.31), (380.0, 400.2), (-3e-4, 2e-4), (0.0, 1.3e6)])
def test_ticks_are_round_and_even(low, high):
    values = np.array([value for value, _ in ticks(low, high)])
    assert 3 <= len(values) <= 8 and values[0] >= low - 1e-9 and values[-1] <= high * (1 + 1e-9)
    steps = np.diff(values)
    assert steps == pytest.approx(steps[0])
    assert f"{steps[0]:.0e}"[0] in "125" and steps[0] == pytest.approx(float(f"{steps[0]:.0e}"))
    # The text is the whole value.
    assert [float(text) for _, text in ticks(low, high)] == pytest.approx(values, abs=1e-12)


def test_a_click_gives_the_place_that_is_drawn_there():
    across, up = np.linspace(-7, 22, 30), np.linspace(380, 390, 30)
    plot = Plot(across, up, "Y / mm", "Z <mm>", downwards=True, marks=[(3.0, 385.0)])
    text = plot.draw()
    drawn = np.array(re.findall(r"M([\d.]+) ([\d.]+)h0", text), float)
    assert len(drawn) == 30
    assert [plot.place_of(u) for u in drawn[:, 0]] == pytest.approx(across, abs=0.01)
    # Z increases downwards, and texts are escaped.
    assert (np.diff(drawn[:, 1]) > 0).all() and "Z &lt;mm&gt;" in text and text.count("<circle") == 1


def test_equal_points_and_bars_are_drawn():
    assert "h0" in Plot(np.zeros(3), np.full(3, 5.0), "a", "b").draw()
    text = Plot(np.array([0.5, 1.5]), np.array([3, 1]), "Z / mm", "points", bar_width=1.0).draw()
    heights = [float(base) - float(top) for base, top in re.findall(r"M[\d.]+ ([\d.]+)V([\d.]+)h", text)]
    assert heights[0] == pytest.approx(3 * heights[1], abs=0.3)
