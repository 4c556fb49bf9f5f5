"""Halo of single scattering against quadrature, and the energy of its sum over all orders."""

import math

import numpy as np
from scipy.integrate import quad

from uwlts.model.phase_functions import HenyeyGreenstein
from uwlts.radiometry.stripe_light import STEP_PX, HaloKernel, line_spread


def test_line_spread_of_isotropic_scattering():
    """With p = 1 / (4 pi), the sum of l / (r^2 + y^2)^1.5 over y from -D to D is 2 D l / (r^2 sqrt(r^2 + D^2)).

    r^2 is x^2 + l^2. The trapezoidal rule on logarithmic nodes with a ratio of 1.2 has an error below 1 %.
    """
    path = 300.0
    distance = np.array([0.1, 1.0, 10.0, 50.0])
    found = line_spread(lambda angle: np.full_like(angle, 1 / (4 * math.pi)), distance, path)

    def along(length: float, x: float) -> float:
        square = x * x + length * length
        return 2 * path * length / (square * math.sqrt(square + path * path)) / (4 * math.pi)

    expected = [quad(along, 0, path, args=(x,), points=[x], limit=200)[0] for x in distance]
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_kernel_without_scattering_is_the_gaussian_stripe():
    kernel = HaloKernel(HenyeyGreenstein(0.9).per_sr, ((300.0, 0.4), (250.0, 0.5)))
    x = kernel.place_px
    expected = np.exp(-0.5 * (x / 1.5) ** 2) / (1.5 * math.sqrt(2 * math.pi))
    np.testing.assert_allclose(kernel.profile(0.0, sigma_px=1.5), expected, atol=1e-9)


def test_kernel_is_the_line_spread_of_its_paths():
    """A weak halo is the spread of both paths, per px.

    From 12 px on, the spread changes by 1 % within a cell of 0.5 px at most. Cells that follow the nodes, with a ratio
    of 1.5, instead of the curve between them deviate by up to 5 %.
    """
    per_sr, paths = HenyeyGreenstein(0.9).per_sr, ((300.0, 0.4), (250.0, 0.5))
    kernel, b = HaloKernel(per_sr, paths), 1e-8
    tail = (kernel.place_px > 12) & (kernel.place_px < 90)
    expected = sum(scale * line_spread(per_sr, scale * kernel.place_px[tail], path) for path, scale in paths)
    np.testing.assert_allclose(kernel.profile(b, sigma_px=1.5)[tail] / b, expected, rtol=0.01)


def test_kernel_keeps_the_light_of_both_paths():
    """All orders of b D add up to exp(b D) times the unscattered light.

    The trapezoidal rule of the line spread adds some percent close to the sheet. The kernel lacks light that is
    scattered beyond its 1,000 px (0.5 m), and backwards: also some percent.
    """
    kernel = HaloKernel(HenyeyGreenstein(0.95).per_sr, ((300.0, 0.5), (300.0, 0.5)))
    b = 0.5e-3
    whole = STEP_PX * kernel.profile(b, sigma_px=1.0).sum()
    assert 0.9 * math.expm1(600 * b) < whole - 1 < 1.06 * math.expm1(600 * b)
