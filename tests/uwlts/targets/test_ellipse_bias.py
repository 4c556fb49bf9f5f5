"""The bias of circle centres against the conic of the circle mapped by the homography."""

import numpy as np
import pytest

from uwlts.errors import CalibrationError
from uwlts.targets.detection.ellipses import circle_centre_bias

FOCAL, CENTRE = 2450.0, (639.5, 511.5)


def rotation(rx_deg, ry_deg):
    (cx, cy), (sx, sy) = np.cos(np.deg2rad([rx_deg, ry_deg])), np.sin(np.deg2rad([rx_deg, ry_deg]))
    return np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])


def pinhole(turn, shift):
    def project(points):
        x, y, z = (points @ turn.T + shift).T
        return np.stack([FOCAL * x / z + CENTRE[0], FOCAL * y / z + CENTRE[1]], 1)

    return project


def conic_bias(turn, shift, centre, radius):
    """Closed form: the circle's conic C becomes H^-T C H^-1, whose centre is the pole of the line at infinity."""
    camera = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
    homography = camera @ np.column_stack([turn[:, 0], turn[:, 1], shift])
    x, y = centre[:2]
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
    # The dual conic H C^-1 H^T applied to (0, 0, 1).
    pole = homography @ np.linalg.inv(circle) @ homography.T[:, 2]
    image = homography @ np.array([x, y, 1])
    return pole[:2] / pole[2] - image[:2] / image[2]


def test_bias_of_a_pinhole_equals_the_closed_form():
    centres = np.array([[x, y, 0.0] for x in (-60, 0, 45) for y in (-40, 5, 50)])
    largest = 0.0
    for rx, ry in ((0, 0), (40, 0), (-25, 35), (0, 50)):
        for diameter in (2.0, 5.0, 8.0):
            turn, shift = rotation(rx, ry), np.array([4.0, -7.0, 300.0])
            found = circle_centre_bias(pinhole(turn, shift), centres, diameter_mm=diameter)
            expected = np.array([conic_bias(turn, shift, centre, diameter / 2) for centre in centres])
            # Both are exact; pixels of 1e3 carry 1e-13, which inverting a conic that is 1e4 px^2 large against its
            # 10 px ellipse and its fit may raise by 1e4.
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)
            largest = max(largest, np.abs(found).max())
    # The sweep holds biases that matter: more than a tenth of a pixel.
    assert largest > 0.1


def test_bias_grows_with_the_square_of_the_diameter():
    project = pinhole(rotation(30, 20), np.array([0.0, 0.0, 350.0]))
    small, large = (circle_centre_bias(project, [[10.0, -20.0, 0.0]], diameter_mm=d) for d in (1.0, 3.0))
    # The next order is (r tan(tilt) / distance)^2 = (1.5 * 0.7 / 350)^2 = 1e-5 of it.
    np.testing.assert_allclose(large, 9 * small, rtol=1e-4)


def test_square_on_without_distortion_there_is_no_bias_and_distortion_makes_one():
    def distorted(points):
        pixels = plain(points) - CENTRE
        return pixels * (1 - 0.3 * (pixels**2).sum(1, keepdims=True) / FOCAL**2) + CENTRE

    plain = pinhole(np.eye(3), np.array([0.0, 0.0, 350.0]))
    np.testing.assert_allclose(circle_centre_bias(plain, [[60.0, 0.0, 0.0]], diameter_mm=5.0), 0, atol=1e-8)
    ((du, dv),) = circle_centre_bias(distorted, [[60.0, 0.0, 0.0]], diameter_mm=5.0)
    # On the rim of radius a around (r, 0) the map x (1 + k |x|^2) adds, to second order in a, k r a^2 (2 + cos 2t)
    # along the radius and k r a^2 sin 2t across it. Along the normal (cos t, sin t) this has the first harmonic
    # k r a^2 (2 + 1/2 + 1/2) cos t, which moves a fitted ellipse by 3 k r a^2 px. Neglected: a^4, (2.5 / 60)^2 = 0.2 %,
    # and the focal length's scale of k, k r^2 = 1 %.
    assert du == pytest.approx(3 * -0.3 * (60 / 350) * (2.5 / 350) ** 2 * FOCAL, rel=0.02)
    assert dv == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("turn", "centre", "message"),
    [
        (rotation(0, 0), [np.nan, 0, 0], "cannot be projected"),
        # The circle spans the plane z = 0 of the camera: its image is a hyperbola.
        (rotation(90, 0), [0, -300.0, 0], "no ellipses"),
    ],
)
def test_impossible_requests_are_refused(turn, centre, message):
    with pytest.raises(CalibrationError, match=message):
        circle_centre_bias(pinhole(turn, np.array([1.0, 20.0, 301.0])), [centre], diameter_mm=40.0)


def test_no_circles_give_no_biases():
    project = pinhole(rotation(0, 0), np.array([0.0, 0.0, 300.0]))
    bias = circle_centre_bias(project, np.empty((0, 3)), diameter_mm=5.0)
    assert bias.shape == (0, 2)
