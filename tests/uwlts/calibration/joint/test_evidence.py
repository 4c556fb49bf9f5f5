"""Compare points of the sheet calculated with a table for many stripe pixels with those of each single pixel."""

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from uwlts.calibration.joint.problem import joint_problem
from uwlts.calibration.joint.residuals import SeenSheet
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions

FEWEST = 5000
"""Smallest number of pixels for the use of a table."""


@pytest.fixture(scope="module")
def problem(thesis):
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
    series = target_series(built_sensor(), medium=0, positions=np.arange(6) * 36.0 - 120.0, noise=noise)
    return joint_problem(gathered(thesis, [series]), options=CalibrationOptions())


@pytest.fixture(scope="module")
def pixels(problem):
    """Return thousands of pixels with integer line numbers, near the stripes of the target."""
    at_px = np.tile(np.rint(problem.evidence[0].pixels), (12, 1))
    at_px[:, 1] += np.random.default_rng(5).uniform(-1.0, 1.0, len(at_px))
    assert len(at_px) >= FEWEST
    return at_px


def seen(problem, pixels) -> SeenSheet:
    evidence = problem.evidence[0]
    return SeenSheet.from_parameters(
        problem.parameters, problem.global_values, evidence.view, pixels, across=evidence.across
    )


def test_points_by_a_table_are_those_of_each_pixel(problem, pixels):
    """The table's error is 1e-7 mm, and 1e-7 of the largest derivative; ten times as much between its nodes."""
    sheet = seen(problem, pixels)
    assert sheet.table is not None
    some = np.random.default_rng(3).choice(len(pixels), 300, replace=False)
    found, expected = sheet.points(some), sheet.exact(pixels[some])
    assert found is not None and expected is not None
    np.testing.assert_allclose(found.points, expected.points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sheet.places_mm()[:, some], expected.points, rtol=0, atol=1e-6)
    largest = np.abs(expected.by).max(axis=0)
    assert (np.abs(found.by - expected.by).max(axis=0) <= 1e-6 * largest + 1e-6).all()


def test_few_pixels_or_pixels_between_lines_have_no_table(problem, pixels):
    for some in (pixels[: FEWEST - 1], pixels + [0.5, 0.0]):
        sheet = seen(problem, some)
        assert sheet.table is None
        np.testing.assert_array_equal(sheet.places_mm(), sheet.points().points)


def test_rays_that_meet_no_sheet_have_no_points(problem, pixels):
    """Pixels far outside the image, where the lens cannot be inverted, many and few."""
    for some in (pixels, pixels[:10]):
        sheet = seen(problem, some + [0.0, 1e6])
        assert sheet.points() is None
        assert sheet.places_mm() is None
