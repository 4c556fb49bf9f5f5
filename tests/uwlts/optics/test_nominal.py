"""Sensors as described: the nominal sheet against Fermat's principle."""

import numpy as np
import pytest

from tests.oracles.fermat import directions_seen, plate
from tests.virtual_sensors import altered
from uwlts.errors import DesignError
from uwlts.model.library import load_sensor
from uwlts.model.placement import laser_pose
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import sheet_surface


@pytest.mark.parametrize("medium", ["air", "water"])
@pytest.mark.parametrize(("turn_deg", "most_mm"), [(0.0, 1e-9), (-0.5, 4e-3), (2.0, 0.016), (8.0, 0.13)])
def test_a_turned_window_of_the_laser_bends_and_shifts_the_nominal_sheet(medium, turn_deg, most_mm):
    """Light of least time to points of the sheet leaves the laser within the plane of its fan.

    The best plane is off by 0.15 mm (rms) at 2 deg in water, and by 0.6 mm at 8 deg. A turn about the sheet's normal
    alone does not change the sheet.
    """
    turned = {"laser": {"window": {"tilt_x_deg": 3.0, "tilt_y_deg": turn_deg}}}
    sensor = altered(load_sensor("thesis"), turned)
    pose, glass, known = laser_pose(sensor), sensor.laser.window, sensor.medium(medium)
    frame = np.stack([pose.normal, pose.fan, pose.axis])
    y, z = (each.ravel() for each in np.meshgrid(np.linspace(-150, 150, 7), np.linspace(300, 550, 3)))
    index = known.refractive_index(sensor.laser.wavelength_nm)
    surface = sheet_surface(nominal_calibration(sensor, known).sheet, medium_index=index)
    plane = pose.origin_mm[:, None] + np.outer(pose.fan, y) + np.outer(pose.axis, z)
    reach, _ = surface.crossings(plane, np.repeat(pose.normal[:, None], len(y), axis=1))
    points = (plane + reach * pose.normal[:, None] - pose.origin_mm[:, None]).T @ frame.T
    faces = plate(distance=glass.distance_mm, thickness=glass.thickness_mm, normal=glass.normal())
    left = directions_seen(points, faces, [1.0, glass.index(sensor.laser.wavelength_nm), index])
    assert np.abs(left[:, 0] * z).max() < most_mm


def test_a_bow_bends_the_nominal_sheet_and_a_plane_has_no_fan():
    bowed = nominal_calibration(altered(load_sensor("thesis"), {"laser": {"bow_deg": 0.4}})).sheet
    assert bowed.fan is not None and bowed.fan.bow_rad == pytest.approx(np.radians(0.4))
    assert nominal_calibration(load_sensor("thesis")).sheet.fan is None


def test_a_sensor_that_does_not_see_its_sheet_is_refused():
    away = altered(load_sensor("thesis"), {"laser": {"baseline_mm": 5000.0, "triangulation_angle_deg": 2.0}})
    with pytest.raises(DesignError):
        nominal_calibration(away, away.medium("water"))
