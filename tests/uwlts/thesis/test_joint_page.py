"""Summary and page of the joint comparison, from synthetic results."""

import json
import re

import numpy as np
import pytest

from uwlts.errors import OutputError
from uwlts.thesis.joint_comparison import JOINT, SHIFTS, summary_lines, write_joint_comparison
from uwlts.thesis.results import JointResults, PlaneScatter, SphereErrors

FIGURES = ("SSE", "diameter error sphere 1", "diameter error sphere 2", *SHIFTS)


def result(number):
    """Errors in mm of one campaign: of all three methods in water, of two in air."""

    def scan(medium, ways):
        found = {way: dict(zip(FIGURES, (size, -size, size / 2) * 2, strict=True)) for way, size in ways.items()}
        return SphereErrors("near", medium, found, {way: dict.fromkeys(FIGURES, 0.004) for way in JOINT})

    joint = {"joint_same_evidence": 0.05, "joint_with_target_in_water": 0.002, "joint_with_scans": 0.01 * number}
    water = scan("water", {"one_refraction": 0.08, "two_refractions": -0.06} | joint)
    return JointResults(
        campaign=f"campaign-{number}",
        solve_s=dict.fromkeys(JOINT, 8.0 + number),
        spheres=[water, scan("air", {"one_refraction": 0.03} | dict.fromkeys(JOINT, 0.001))],
        planes=[PlaneScatter(placement="standoff", medium="water", std_mm=0.03, over_limit=0.8)],
    )


def test_summary_and_page_say_the_same(tmp_path):
    results = [result(0), result(1)]
    summary = write_joint_comparison(tmp_path, results)
    written = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert written.pop("sha256")
    assert written == summary.model_dump()
    assert summary.spacing_error_mm["joint_with_scans"] == [0.0, 0.01]
    assert summary.diameter_error_mm["two_refractions"] == [0.06, -0.03] * 2
    assert summary.plane_std_over_speckle_limit == [0.8, 0.8]
    # Of twelve figures in water 0.01, -0.01 and 0.005 mm twice in the second campaign: four beyond 1.96 x 0.004 mm.
    held = {"joint_same_evidence": 0.0, "joint_with_target_in_water": 1.0, "joint_with_scans": 8 / 12}
    assert summary.coverage_95 == pytest.approx(held)
    assert summary.solve_s == {way: [8.0, 9.0] for way in JOINT}
    assert "two_refractions" not in summary.air.spacing_error_mm
    assert any("with scans too 0.0050 mm (largest 0.0100)" in line for line in summary_lines(summary))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    rows = re.findall(r'<td class="words">sphere spacing</td><td class="words">([a-z ,]+)</td><td>([0-9.]+)</td>', page)
    expected = [np.mean(np.abs(e)) for e in summary.spacing_error_mm.values()]
    assert [float(mean) for _, mean in rows[:5]] == pytest.approx(expected, abs=5e-5)
    assert page.count("<svg") == 2
    assert "0.80 times the speckle limit" in page
    assert "with scans too 67 %" in page


def test_existing_results_are_not_overwritten(tmp_path):
    write_joint_comparison(tmp_path, [result(1)])
    with pytest.raises(OutputError, match="report.html"):
        write_joint_comparison(tmp_path, [result(1)])
    write_joint_comparison(tmp_path, [result(2)], overwrite=True)
