"""Warnings and limits that a verification reports beside its verdicts."""

from dataclasses import replace

import numpy as np
import pytest

import uwlts
from uwlts.errors import EvaluationError
from uwlts.model.library import load_sensor
from uwlts.model.sensor import CaptureHeader, Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.reconstruction.verify import find_undetectable_errors
from uwlts.report.file_description import evaluation_lines
from uwlts.storage.capture import Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud


def test_a_reversed_stage_that_sizes_cannot_show_is_named():
    """A reversed stage that moves square to the sheet mirrors the cloud, which does not change lengths.

    At 30 deg from this direction, it shears the cloud by 2 tan 30 deg.
    """
    positions = np.arange(5.0)
    for direction in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)):
        (said,) = find_undetectable_errors("spheres", positions, direction)
        assert "spheres" in said and "mirrors the cloud, such as a reversed stage" in said
        assert (
            "wrong travel" not in said and "wrong travel" in find_undetectable_errors("pipe", positions, direction)[0]
        )
    assert find_undetectable_errors("spheres", positions, (0.866, 0.0, 0.5)) == ()
    assert find_undetectable_errors("step", np.zeros(3), (1.0, 0.0, 0.0)) == (), "nothing moved"


SPHERES = {"kind": "spheres", "diameters_mm": [50.0, 50.0], "spacings_mm": [100.0]}


def cloud_with_others(share: float) -> PointCloud:
    """Return points of two spheres, and others far from them, as many as give this fraction."""
    rng = np.random.default_rng(4)
    away = rng.normal(size=(2, 3000, 3))
    away[..., 2] = -np.abs(away[..., 2])
    away *= 25 / np.linalg.norm(away, axis=2, keepdims=True)
    spheres = (away + np.array([[0, -50, 0], [0, 50, 0]])[:, None]).reshape(-1, 3)
    other = rng.uniform(-40, 40, (round(share / (1 - share) * len(spheres)), 3)) + [200, 0, 0]
    points = np.concatenate([spheres, other]) + rng.normal(0, 0.01, (len(spheres) + len(other), 3))
    return PointCloud(points, *np.zeros((3, len(points))))


@pytest.mark.parametrize(("share", "doubted"), [(0.0, False), (0.2, False), (0.5, True)])
def test_the_share_of_points_on_no_artefact_is_judged(share, doubted):
    found = uwlts.evaluate(cloud_with_others(share), SPHERES)
    # A few points of the spheres are outliers or mixed.
    assert found.evaluation.strange_share == pytest.approx(share, abs=0.01)
    assert bool(found.evaluation.doubts()) is doubted
    assert f"({100 * found.evaluation.strange_share:.1f} %) on no artefact" in "".join(evaluation_lines(found))


def test_a_scan_with_half_of_another_one_verifies_nothing(tmp_path, monkeypatch):
    """Sizes by the other half agree with the certificate, so they would pass."""
    header = CaptureHeader(
        name="scan",
        sensor=load_sensor("thesis-small"),
        medium_name="air",
        medium=Medium(kind="air"),
        stage_direction=(1, 0, 0),
        saturation_dn=255,
        artefact=SPHERES,
    )
    with CaptureWriter(tmp_path / "scan.h5", header, dtype=np.uint8) as writer:
        image = np.zeros((header.sensor.camera.height_px, header.sensor.camera.width_px), np.uint8)
        for number in range(3):
            writer.append(Frame(image, stage_mm=number, laser_on=True, exposure_ms=1.0, time_s=number))
    calibration = nominal_calibration(header.sensor)
    doubted = replace(cloud_with_others(0.2), warnings=["exchanged images"])
    clouds = iter([doubted, cloud_with_others(0.5)])
    monkeypatch.setattr("uwlts.reconstruction.verify.reconstruct", lambda *_: next(clouds))
    found = uwlts.verify(tmp_path / "scan.h5", calibration, limit_mm=0.1)
    assert found.passed and found.not_shown[0].startswith("20.")
    assert found.warnings == ["exchanged images"]
    with pytest.raises(EvaluationError, match="nothing is verified: 50 % of the points do not belong"):
        uwlts.verify(tmp_path / "scan.h5", calibration, limit_mm=0.1)
