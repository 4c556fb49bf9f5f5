"""Circles out of focus: found and centred, with a longer reach across the edge if the short one fails."""

import math
from functools import cache

import numpy as np
import pytest

from uwlts.targets.detection import ellipses, find_circles

DARK, BRIGHT = 40.0, 200.0
SPACING, COLUMNS, ROWS = 70, 6, 5
SHAPE = ((ROWS + 1) * SPACING, (COLUMNS + 1) * SPACING)
SHORT = ellipses.RULE._replace(reaches_px=ellipses.RULE.reaches_px[:1])


def places():
    """Return true centres (N, 2) of a lattice, each with its own sub-pixel phase."""
    u, v = np.meshgrid(np.arange(1, COLUMNS + 1) * SPACING, np.arange(1, ROWS + 1) * SPACING)
    lattice = np.column_stack([u.ravel(), v.ravel()])
    return lattice + np.random.default_rng(0).uniform(-0.5, 0.5, lattice.shape)


@cache
def sharp(radius):
    """Return the covered fraction of a point (u, v) relative to the circle's centre: 0 or 1."""
    return lambda u, v: (np.hypot(u, v) < radius).astype(float)


@cache
def blurred(radius, blur):
    """Return the fraction of a disc of radius ``blur`` covered by a larger disc: the area of their intersection."""

    def share(u, v):
        d = np.clip(np.hypot(u, v), radius - blur + 1e-9, radius + blur - 1e-9)
        of_large = np.arccos((d**2 + radius**2 - blur**2) / (2 * d * radius))
        of_small = np.arccos((d**2 + blur**2 - radius**2) / (2 * d * blur))
        kite = np.sqrt((radius + blur - d) * (d + radius - blur) * (d - radius + blur) * (d + radius + blur)) / 2
        return (radius**2 * of_large + blur**2 * of_small - kite) / (np.pi * blur**2)

    return share


def in_steps(radius, blur, count):
    """Return the same for light through only ``count`` points of the pupil, evenly spread by the golden angle."""
    turn = np.arange(count) * np.pi * (3 - math.sqrt(5))
    points = blur * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    points -= points.mean(axis=0)
    return lambda u, v: sum(sharp(radius)(u - a, v - b) for a, b in points) / count


@cache
def on_an_inclined_plate(radius, blur, growth, *, count=100):
    """Return the same for a blur radius that increases by ``growth`` per pixel along v; each point keeps its light."""
    turn = np.arange(count) * np.pi * (3 - math.sqrt(5))
    pupil = np.sqrt((np.arange(count) + 0.5) / count)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    pupil -= pupil.mean(axis=0)

    def share(u, v):
        total = 0.0
        for a, b in pupil:
            # A point (x, y) of the plate is seen at (x, y) + (blur + growth y) (a, b).
            y = (v - blur * b) / (1 + growth * b)
            total = total + sharp(radius)(u - (blur + growth * y) * a, y) / (1 + growth * b)
        return total / count

    return share


@cache
def covered(share, samples):
    """Return the covered fraction of each pixel: the mean of samples x samples points of it."""
    image, side = np.zeros(SHAPE), 2 * (SPACING // 2)
    within = (np.arange(side)[:, None] + (np.arange(samples) + 0.5) / samples - 0.5).ravel()
    for cu, cv in places():
        u0, v0 = round(cu) - side // 2, round(cv) - side // 2
        fine = share(within + u0 - cu, (within + v0 - cv)[:, None])
        image[v0 : v0 + side, u0 : u0 + side] = fine.reshape(side, samples, side, samples).mean((1, 3))
    return image


def photograph(share, *, samples, bright=True, noise=0.0, shading=0.0):
    """Return an image of the lattice, with ``shading`` per pixel of u."""
    image = covered(share, samples)
    levels = DARK + (BRIGHT - DARK) * (image if bright else 1 - image)
    levels = levels * (1 + shading * (np.arange(SHAPE[1]) - SHAPE[1] / 2))
    return np.clip(np.rint(levels + noise * np.random.default_rng(1).normal(size=SHAPE)), 0, 255).astype(np.uint8)


def errors_px(found):
    """Return distances (N,) of the found centres from the true ones; each circle must be found once."""
    apart = np.linalg.norm(found.centres[:, None] - places(), axis=2)
    assert sorted(apart.argmin(axis=1).tolist()) == list(range(COLUMNS * ROWS))
    return apart.min(axis=1)


def rms(errors):
    return math.sqrt(np.mean(errors**2))


# The band of pixels with fractional weights reaches 5.3 px to either side of the ellipse, for an edge that is a ramp
# over the whole short reach. It contains a blur of 4 px. The remaining errors are rounding to grey levels, 0.29 / 160
# divided by the root of about a hundred edge pixels, and the sampling of the levels beside the edge. For a blur of 6 px
# it cuts off the last 0.7 px, depending on the pixels' phase: measured 0.02 px for the large circles, 0.06 px for the
# small ones.
@pytest.mark.parametrize("bright", [True, False])
@pytest.mark.parametrize(("blur", "limit"), [(4.0, 0.003), (6.0, 0.07)])
@pytest.mark.parametrize("radius", [12.5, 17.0, 25.0])
def test_blurred_circles_are_found_and_centred(radius, blur, limit, bright):
    assert rms(errors_px(next(find_circles(photograph(blurred(radius, blur), samples=3, bright=bright))))) < limit


# Shading of 0.08 % per pixel pulls the centroid of a disc of 11 px by 0.0008 x 11^2 / 4 = 0.024 px. There is no room
# within the circle to read it beside edges as wide as these, and a slope read in them is that of the blur's growth.
@pytest.mark.parametrize("bright", [True, False])
@pytest.mark.parametrize("shading", [-8e-4, 8e-4])
def test_shading_does_not_pull_circles_whose_blur_grows_across_the_plate(shading, bright):
    image = photograph(on_an_inclined_plate(11.0, 4.2, 0.006), samples=2, bright=bright, shading=shading)
    found = next(find_circles(image))
    off = found.centres - places()[np.linalg.norm(found.centres[:, None] - places(), axis=2).argmin(axis=1)]
    assert len(found) == COLUMNS * ROWS
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.004


def test_noise_moves_blurred_circles_by_its_share_of_the_contrast():
    noise = 2.0
    errors = errors_px(next(find_circles(photograph(blurred(25.0, 4.0), samples=3, noise=noise))))
    # A band of half width B around a circle of radius r contains 4 pi r B pixels at the distance r. Each moves the
    # centroid by noise / contrast / (pi r^2) of its distance: sqrt(2 B / (pi r)) noise / contrast per coordinate. The
    # levels inside and outside, each measured on 48 pixels, add about the same amount each. B is 5.3 px.
    alone = math.sqrt(2) * math.sqrt(2 * 5.3 / (math.pi * 25.0)) * noise / (BRIGHT - DARK)
    assert 0.5 * alone < rms(errors) < 4 * alone


@pytest.mark.parametrize(("radius", "count", "blur"), [(14.0, 16, 6.0), (14.0, 8, 4.0), (20.0, 8, 6.0)])
def test_edges_in_steps_need_the_longer_reach(radius, count, blur, monkeypatch):
    image = photograph(in_steps(radius, blur, count), samples=5)
    # Steps in the image are symmetric like those in the pupil: the remaining error is rounding, as above.
    assert rms(errors_px(next(find_circles(image)))) < 0.004
    monkeypatch.setattr(ellipses, "RULE", SHORT)
    assert len(next(find_circles(image))) < (1 - ellipses.RULE.missed_share) * COLUMNS * ROWS


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("share", [sharp(6.0), sharp(14.0), blurred(14.0, 1.5)])
def test_images_in_focus_are_measured_as_with_the_short_reach_alone(share, noise, monkeypatch):
    image = photograph(share, samples=6, noise=noise)
    found = next(find_circles(image))
    assert len(found) == COLUMNS * ROWS
    monkeypatch.setattr(ellipses, "RULE", SHORT)
    alone = next(find_circles(image))
    np.testing.assert_array_equal(found.centres, alone.centres)
    np.testing.assert_array_equal(found.shapes, alone.shapes)
