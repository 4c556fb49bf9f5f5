"""Joint calibrations with one image that prevents any solution: it is left out by name, or a refusal names it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.lens import LensChoice
from uwlts.calibration.joint import estimate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.parameter_keys import LensParameter

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False, lens=LensChoice())


@pytest.fixture(scope="module")
def in_air():
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(3))
    return target_series(BUILT, window=False, positions=np.linspace(-200, 60, 9), noise=noise, columns=7)


def turned(image):
    return replace(image, points_mm=image.points_mm * [-1, -1, 1])


def misread(image):
    further = np.where(image.points_mm[:, :1] > 0, [9.375, 0, 0], 0.0)
    return replace(image, points_mm=image.points_mm + further)


def elsewhere(image):
    return replace(image, stage_mm=image.stage_mm + 20.0)


def edited(series, edit):
    """Return the series with the fifth image edited."""
    images = [edit(image) if number == 4 else image for number, image in enumerate(series.found.images)]
    return replace(series, found=replace(series.found, images=images, captures=["air.h5"]))


@pytest.mark.parametrize("edit", [turned, misread, elsewhere])
def test_an_image_that_prevents_any_solution_is_left_out_by_name(thesis, in_air, edit):
    result = solve_jointly(gathered(thesis, [edited(in_air, edit)]), options=OPTIONS)
    assert [said.split(":")[0] for said in result.warnings if said.endswith("left out")] == ["air.h5, frame 4"]
    focal_px = BUILT.camera.focal_length_px()
    # 4.5 standard uncertainties: exceeded by chance once in 150,000
    assert abs(result.calibration.camera.fx_px - focal_px) < 4.5 * result.estimate.std()[LensParameter.F]


def test_a_refusal_names_the_image_and_lists_all(thesis, in_air):
    with pytest.raises(CalibrationError, match="air.h5, frame 4: the target is ") as refused:
        solve_jointly(gathered(thesis, [edited(in_air, turned)]), options=replace(OPTIONS, strict=True))
    table = str(refused.value).splitlines()[1:]
    assert table[0].split()[:4] == ["image", "stage,", "mm", "points"]
    assert {row[:15] for row in table[1:]} == {f"air.h5, frame {number}" for number in range(9)}


def test_what_does_not_fit_is_named_if_nothing_converges(thesis, in_air, monkeypatch):
    monkeypatch.setattr(estimate, "_ROUNDS", 1)  # the result of the first round is never taken
    off = edited(in_air, lambda image: replace(image, pixels=image.pixels + [5.0, 0.0]))
    with pytest.raises(CalibrationError, match=r"did not converge.* air.h5, frame 4, where the target"):
        solve_jointly(gathered(thesis, [off]), options=replace(OPTIONS, strict=True))
