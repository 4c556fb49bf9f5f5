"""Uncertainties of a sequential calibration are printed, and warned of if they are large for the measuring volume."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwlts.calibration.sequential.sequential_calibration import _warn_of_uncertainty
from uwlts.optics.nominal import nominal_calibration
from uwlts.report.file_description import calibration_lines


def warnings_for(sensor, *, normal_deg, focal_share):
    angle = np.radians(35.0)
    sheet = SimpleNamespace(
        normal_std_rad=np.radians(normal_deg), model=SimpleNamespace(normal=(0.0, -np.cos(angle), np.sin(angle)))
    )
    camera = SimpleNamespace(std=lambda: {"f": 2000.0 * focal_share, "cx": 3.0}, values=lambda: {"f": 2000.0})
    return _warn_of_uncertainty(camera, sheet, sensor)


def test_a_sheet_of_uncertain_direction_is_said_in_mm_of_depth(thesis):
    """Turned by 2.29 deg about the middle of 220 mm: 110 mm tan(2.29 deg) / sin(35 deg) = 7.7 mm."""
    assert thesis.volume.far_mm - thesis.volume.near_mm == 220.0
    (warning,) = warnings_for(thesis, normal_deg=2.29, focal_share=1e-4)
    assert "uncertainty of 2.3 deg, which is 7.7 mm of depth" in warning


@pytest.mark.parametrize(("share", "said"), [(0.9e-3, 0), (1.1e-3, 1)])
def test_the_limit_is_a_thousandth_of_the_volume(thesis, share, said):
    normal_deg = np.degrees(np.arctan(share * 2 * np.sin(np.radians(35.0))))
    assert len(warnings_for(thesis, normal_deg=normal_deg, focal_share=1e-5)) == said
    assert len(warnings_for(thesis, normal_deg=1e-4, focal_share=share)) == said


def test_the_command_prints_them(thesis):
    """As in the file, for a calibration that states them."""
    figures = {"camera": {"std": {"f": 1.25, "cx": 2.0, "cy": 3.5, "k1": 0.004}}, "sheet": {"normal_std_deg": 0.031}}
    nominal = nominal_calibration(thesis)
    lines = calibration_lines(nominal.model_copy(update={"residuals": figures}))
    assert f"  focal length: {nominal.camera.fx_px:.6g} ± 1.2 px" in lines
    assert f"  row of the principal point: {nominal.camera.cy_px:.6g} ± 3.5 px" in lines
    assert "  direction of the sheet's normal: ± 0.031 °" in lines
    assert not any("standard uncertainties" in line for line in calibration_lines(nominal))
