"""Report of an inspection: contents of page, JSON and PDF, and rejected inputs."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

import uwlts
from uwlts.cli import app
from uwlts.errors import EvaluationError, OutputError, SetupError
from uwlts.files.writing import hash_file
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.inspection.findings_order import FindingOrder
from uwlts.model.artefacts import SphereStandard
from uwlts.pages import toolkit
from uwlts.report.findings_page import _conclude
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty

DEPTH_MM, NOISE_MM = 1.5, 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A pipe of 120 mm diameter with one pit, whose cloud names a calibration."""
    rng, radius = np.random.default_rng(9), 60.0
    x, angle = np.meshgrid(np.arange(0, 80, 0.8), np.radians(np.arange(-60, 60, 0.8)), indexing="ij")
    frame = np.repeat(np.arange(len(x)), x.shape[1])
    x, angle = x.ravel(), angle.ravel()
    away = np.hypot(x - 40, radius * angle) / 6
    r = radius - DEPTH_MM * np.where(away < 1, (1 - away**2) ** 2, 0)
    points = np.column_stack([x, r * np.sin(angle), 400 - r * np.cos(angle)])
    points[:, 2] += NOISE_MM * rng.normal(size=len(x))
    random = np.tile([NOISE_MM**2 * (i == j == 2) for i, j in PAIRS], (len(x), 1)).astype(np.float32)
    nothing = np.zeros_like(points, np.float32)
    known = PointUncertainty(random, nothing, nothing[None])
    metadata = {"capture": "pipe.h5", "sensor": "thesis", "calibration": "0" * 64}
    cloud = PointCloud(points, np.ones(len(x)), frame, np.zeros(len(x), int), uncertainty=known, metadata=metadata)
    folder = tmp_path_factory.mktemp("pipe")
    cloud.save(folder / "pipe.ply")
    evaluation = uwlts.evaluate(_ball(rng, calibration="0" * 64), SphereStandard(diameters_mm=(50.0,)))
    evaluation.save(folder / "ball.evaluation.json")
    return folder


def _ball(rng, *, calibration):
    """The half of a sphere of 50 mm that faces the sensor."""
    way = rng.normal(size=(4000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    points = (25.0 + NOISE_MM * rng.normal(size=(len(way), 1))) * way * np.where(way[:, 2:] > 0, -1, 1) + [0, 0, 400]
    none = np.full(len(points), -1)
    metadata = {"capture": "ball.h5", "calibration": calibration}
    return PointCloud(points, np.ones(len(points)), none, none, metadata=metadata)


def test_page_json_and_pdf_say_the_same(folder, chromium, monkeypatch):
    monkeypatch.chdir(folder)
    words = ["findings-report", "pipe.ply", "--wall-mm", "8", "--captures", "pipe.ply", "--out", "report.html", "--pdf"]
    words += ["--verification", "ball.evaluation.json", "--order", "order.toml"]
    order = (
        'object = "Pile 7"\nreport = "2026-117"\nchecked_by = "M. Okafor"\ndate = 2026-11-20\nlimits.depth_mm = 1.0\n'
    )
    (folder / "order.toml").write_text(order)
    app(words, result_action="return_value")
    record = json.loads((folder / "report.findings.json").read_text())
    pits = [each for each in record["inspection"]["features"] if each["kind"] == "pit"]
    assert len(pits) == 1
    wall = pits[0]["values"]["remaining wall"]
    # The noise of one point is 0.02 mm.
    assert wall["value"] == pytest.approx(8 - DEPTH_MM, abs=5 * NOISE_MM)
    assert record["sources"][0]["sha256"] == hash_file(folder / "pipe.ply")
    assert record["sources"][-1]["sha256"] == hash_file(folder / "ball.evaluation.json")
    (check,) = record["verification"]
    (diameter,) = (each for each in check["figures"] if each["calibrated_mm"] == 50.0)
    # Of 4000 points with 0.02 mm of noise; all figures are below a tenth of a mm.
    assert abs(diameter["value_mm"]) < 0.005
    page = chromium.new_page()
    page.goto((folder / "report.html").as_uri())
    text = page.inner_text("main")
    verdict = page.locator("td.mark.bad").inner_text()
    cut = page.evaluate("document.documentElement.scrollWidth > innerWidth")
    page.close()
    assert text.startswith("Pile 7") and verdict == "exceeds the limit (depth)" and not cut
    for stated in ("2026-117", "20 November 2026", "M. Okafor", f"{wall['value']:.3f}"):
        assert stated in text
    # The scan covers 120 of 360 deg; cells at both borders may count either way.
    unseen = re.search(r"(\d+) % of the circumference over the scanned length have no points", text)
    assert unseen is not None and float(unseen[1]) == pytest.approx(100 * 240 / 360, abs=2)
    # Noise along Z alone; most of it is across the surface.
    point = re.search(r"± ([\d.]+) mm \(random", text)
    assert point is not None and 0.5 * 1.96 * NOISE_MM <= float(point[1]) <= 1.96 * NOISE_MM
    assert diameter["name"].replace("_", " ") in text
    for part in ("GUM", "VDI/VDE 2634", "ASME B31G", "Traceability", record["sources"][0]["sha256"]):
        assert part in text
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("omitted", "more"), [(0, ""), (50, " 25 % of the points are not inspected.")])
def test_the_conclusion_says_how_much_is_not_inspected(omitted, more):
    """A second body covers a quarter of a pipe."""
    found = Inspection("pipe", (), np.where(np.arange(200) < omitted, np.nan, 0.0))
    assert _conclude([], FindingOrder(), found) == ("no limit", "No finding." + more)
    pit = Feature(FeatureKind.PIT, "pit 1", (), np.zeros(3), np.eye(3), np.zeros(3), np.arange(3))
    assert _conclude([pit, pit], FindingOrder(), found) == ("no limit", "Findings: 2 × no limit." + more)


def test_foreign_calibrations_and_missing_browsers_are_refused(folder, tmp_path, monkeypatch):
    uwlts.nominal("thesis", medium="water").save(tmp_path / "other.json")
    with pytest.raises(EvaluationError, match="another calibration"):
        uwlts.report.write_findings(folder / "pipe.ply", out=tmp_path / "a.html", calibration=tmp_path / "other.json")
    with pytest.raises(EvaluationError, match="give that, too"):
        uwlts.report.write_findings(folder / "pipe.ply", out=tmp_path / "a.html", certificate=tmp_path / "other.json")
    foreign = uwlts.evaluate(
        _ball(np.random.default_rng(1), calibration="1" * 64), SphereStandard(diameters_mm=(50.0,))
    )
    foreign.save(tmp_path / "foreign.json")
    with pytest.raises(EvaluationError, match="by another calibration"):
        uwlts.report.write_findings(
            folder / "pipe.ply", out=tmp_path / "a.html", verification=[tmp_path / "foreign.json"]
        )
    with pytest.raises(OutputError, match="give a name like a.html"):
        uwlts.report.write_findings(folder / "pipe.ply", out=tmp_path / "a.json")
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setattr(toolkit, "shutil", SimpleNamespace(which=lambda name: None))
    with pytest.raises(SetupError, match="needs Chromium"):
        uwlts.report.write_findings(folder / "pipe.ply", out=tmp_path / "a.html", pdf=True)
    assert {path.name for path in tmp_path.iterdir()} == {"other.json", "foreign.json"}
