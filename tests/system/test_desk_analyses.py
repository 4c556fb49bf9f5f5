"""Analyses on the operator's page: from a cloud to findings, report and exported files, without the command line."""

import json
import re
from typing import TYPE_CHECKING

from tests.system.test_desk import DESCRIPTIONS, desk, page, press, says, served, tab
from tests.uwlts.desk.test_analyses import weld_cloud

if TYPE_CHECKING:
    from playwright.sync_api import Page

__all__ = ["DESCRIPTIONS", "desk", "page", "served"]


def choose(page: "Page", label: str, option: str) -> None:
    page.get_by_role("combobox", name=label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()


def test_a_cloud_becomes_findings_a_report_and_exported_files(desk, page):
    weld_cloud().save(desk.folder / "weld.ply")
    tab(page, "Inspect")
    choose(page, "analysis", "inspect weld")
    press(page, "analyse")
    says(page, "error: inspect weld: choose the cloud first")
    choose(page, "cloud", "weld.ply")
    press(page, "analyse")
    says(page, "wrote weld-weld.html, weld-weld.findings.json, weld-weld-coloured.ply")
    # Place and interval of the finding, and the coloured cloud.
    text = page.locator(".finding").inner_text()
    height, half = map(float, re.search(r"height ([\d.]+) ± ([\d.]+) mm", text).groups())
    # An error of 4.5 standard uncertainties occurs 7 times in a million.
    assert abs(height - 2.0) < 4.5 / 1.96 * half and re.search(r"X 14\.\d +Y -?0\.\d +Z 398\.\d mm", text)
    page.locator('.cloud-view[data-points="12000"]').wait_for()
    press(page, "mark")
    with page.expect_popup() as opened:
        page.get_by_role("link", name="open the report").click()
    opened.value.get_by_role("heading", name="Inspection of weld.ply").wait_for()
    opened.value.close()
    with page.expect_download() as got:
        page.locator(".tools").get_by_role("link", name="weld-weld.findings.json").first.click()
    kept = json.loads(got.value.path().read_text(encoding="utf-8"))
    assert kept == json.loads((desk.folder / "weld-weld.findings.json").read_text(encoding="utf-8"))
    # Nothing is replaced without being asked.
    report = desk.folder / "weld-weld.html"
    report.write_text("mine", encoding="utf-8")
    press(page, "analyse")
    says(page, "weld-weld.html exists: give another name, or tick 'replace existing'")
    assert report.read_text(encoding="utf-8") == "mine"
    page.get_by_role("checkbox", name="replace existing").click()
    # A cancelled one replaces nothing, either.
    press(page, "analyse")
    page.get_by_text(re.compile(r"inspect weld: weld.ply, \d+ s")).wait_for()
    press(page, "cancel")
    page.get_by_role("alert").get_by_text("cancelled; nothing was written").wait_for()
    assert report.read_text(encoding="utf-8") == "mine"
    choose(page, "analysis", "export")
    # The form before it has a cloud, too.
    page.get_by_role("combobox", name="format", exact=True).wait_for()
    choose(page, "cloud", "weld.ply")
    choose(page, "format", ".xyz")
    page.get_by_label("name of the results").fill("for-others")
    press(page, "analyse")
    says(page, "wrote for-others.xyz")
    with page.expect_download() as got:
        page.locator(".tools").get_by_role("link", name="for-others.xyz").first.click()
    assert len(got.value.path().read_text(encoding="utf-8").splitlines()) == 1 + 12_000
