"""The operator's page on a desktop, a tablet and a phone: everything in sight, keys in order."""

from itertools import pairwise
from typing import TYPE_CHECKING

import pytest

from tests.system.test_desk import DESCRIPTIONS, TABS, desk, served, sized, tab
from tests.uwlts.desk.test_analyses import step_cloud

if TYPE_CHECKING:
    from playwright.sync_api import Page

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
