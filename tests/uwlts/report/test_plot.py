"""Plots of clouds, stripes and residuals, and numbers on pages."""

import base64
import gzip
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from matplotlib.colors import to_hex

from uwlts.errors import CalibrationError
from uwlts.model.library import load_sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.pages.cloud_display import choose_points
from uwlts.pages.cloud_figure import colour_limit_mm
from uwlts.pages.toolkit import figure_png, figure_svg, format_fixed, format_to_scale
from uwlts.report import plot
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import extract_stripe

WIDTH, HEIGHT = 160, 120
MOST_POINTS = 12_000


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    """Close figures that pyplot would show: it warns of more than twenty."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def stripe_image(row: np.ndarray) -> np.ndarray:
    """A Gaussian stripe, sigma 1.2 px, at a row for each of the columns."""
    away = np.arange(HEIGHT)[:, None] - row
    return np.round(200 * np.exp(-0.5 * (away / 1.2) ** 2)).astype(np.uint8)


def unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


RESIDUALS = {
    "camera": {"rms_px": 0.0173, "image_rms_px": [0.02, 0.015, 0.01, 0.03], "covariance": [[1.0]]},
    "window": {
        "images": ["a", "b", "c", "<b>d</b>"],
        "errors_mm": [0.003, -0.004, 0.0, 0.0],
        "image_distances_mm": [47.2, None, 47.4, 47.5],
    },
}


def test_plots_have_units_on_their_axes():
    y = np.linspace(-40, 40, 2000)
    points, nothing = np.column_stack([0 * y, y, 0 * y]), np.zeros(len(y), int)
    cloud = PointCloud(points, nothing, nothing, nothing, deviation_mm=0.01 * np.sin(y))
    calibration = nominal_calibration(load_sensor("thesis")).model_copy(update={"residuals": RESIDUALS})
    lists = ["camera.image_rms_px", "window.errors_mm", "window.image_distances_mm"]
    flat = [plot.residuals(calibration, which=each) for each in lists]
    assert plot.residuals(calibration).get_ylabel() == flat[0].get_ylabel() == "image rms / px"
    with pytest.raises(CalibrationError, match=f"it has {', '.join(lists)}"):
        plot.residuals(calibration, which="camera.covariance")
    counts = {"image", ""}
    titles = [title for ax in flat for title in (ax.get_xlabel(), ax.get_ylabel())]
    assert all(title in counts or title.split(" / ")[-1] in ("mm", "µm", "px") for title in titles)
    solid = plot.cloud(cloud)
    assert [solid.get_xlabel(), solid.get_ylabel(), solid.get_zlabel()] == ["X / mm", "Y / mm", "Z / mm"]


def test_centres_are_drawn_where_the_light_is():
    row = 60.37 + 0.02 * np.arange(WIDTH)
    image = stripe_image(row)
    found = extract_stripe(image, stripe_along="width")
    for enlarged in (False, True):
        ax = plot.stripe(image, found, enlarged=enlarged)
        columns, centres = ax.lines[0].get_xydata().T
        assert len(columns) > 40
        # Image coordinates, whole numbers at pixel centres; the stripe is found to far better than 0.05 px.
        assert np.abs(centres - row[columns.astype(int)]).max() < 0.05
        assert tuple(ax.images[0].get_extent()) == (-0.5, WIDTH - 0.5, HEIGHT - 0.5, -0.5)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert left < columns.min() < columns.max() < right and top < centres.min() < centres.max() < bottom


def test_a_standing_stripe_is_shown_lying():
    image = stripe_image(60.37 + 0.02 * np.arange(WIDTH))
    lying = plot.stripe(image, extract_stripe(image, stripe_along="width"))
    turned = np.ascontiguousarray(image.T)
    standing = plot.stripe(turned, extract_stripe(turned, stripe_along="height"))
    assert np.array_equal(lying.images[0].get_array(), standing.images[0].get_array())
    assert np.array_equal(lying.lines[0].get_xydata(), standing.lines[0].get_xydata())
    # Only the names of the axes are exchanged.
    assert (lying.get_xlabel(), lying.get_ylabel()) == (standing.get_ylabel(), standing.get_xlabel())


def test_the_cloud_picture_shows_both_signs_on_their_sides():
    x, y = map(np.ravel, np.meshgrid(np.linspace(-10, 10, 60), np.linspace(-40, 40, 200)))
    nothing = np.zeros(len(x), int)
    cloud = PointCloud(np.column_stack([x, y, 0 * x]), nothing, nothing, nothing, deviation_mm=0.01 * np.sign(y))
    encoded = np.frombuffer(figure_png(plot.cloud(cloud).figure), np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[:, :950].astype(int)
    red = np.argwhere(picture[:, :, 2] - picture[:, :, 0] > 80)
    blue = np.argwhere(picture[:, :, 0] - picture[:, :, 2] > 80)
    assert min(len(red), len(blue)) > 5000
    # Y runs to the right.
    assert red[:, 1].mean() > blue[:, 1].mean() + 200


@pytest.mark.parametrize("colour", ["deviation", "depth", "intensity", "random", "common"])
def test_clouds_are_coloured_by_any_known_attribute(colour):
    nothing = np.zeros(3, int)
    cloud = PointCloud(np.eye(3), np.array([10.0, 20.0, 30.0]), nothing, nothing)
    ax = plot.cloud(cloud, colour=colour)
    (drawn,) = ax.collections
    # Without deviations or uncertainties all points have one colour.
    assert (drawn.get_array() is None) == (colour in ("deviation", "random", "common"))
    if colour == "intensity":
        assert sorted(drawn.get_array()) == [10, 20, 30]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_clouds_of_hardly_any_points_can_be_drawn(count):
    nothing = np.zeros(count, int)
    cloud = PointCloud(np.ones((count, 3)), nothing, nothing, nothing)
    assert figure_png(plot.cloud(cloud).figure).startswith(b"\x89PNG")
    assert json.loads(choose_points(cloud.points_mm, "depth", None, most=9)[0].to_json())["count"] == count


def test_pyplot_shows_plots_and_no_figures_of_pages():
    from matplotlib import pyplot

    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.normal(size=(30, 3)), np.ones(30), np.zeros(30, int), np.arange(30))
    cloud = replace(cloud, deviation_mm=rng.normal(size=30))
    ax = plot.cloud(cloud)
    assert pyplot.get_fignums() == [ax.figure.number]
    figure_svg(ax)
    assert pyplot.get_fignums() == []


def test_the_cloud_is_decimated_and_decoded_to_a_small_step():
    rng = np.random.default_rng(1)
    count = 2 * MOST_POINTS
    points = rng.uniform((-5, -60, 300), (25, 60, 340), (count, 3))
    deviation = rng.normal(0, 0.003, count)
    deviation[::10] = np.nan
    cloud = PointCloud(points, deviation, np.zeros(count), np.zeros(count), deviation_mm=deviation)
    shown, caption = choose_points(points, "deviation", cloud.field_values("deviation"), most=MOST_POINTS)
    assert len(shown.points_mm) == MOST_POINTS
    assert f"{MOST_POINTS:,} of {count:,} points" in caption and "not evaluated" in caption
    # Two standard deviations of single-precision values, in micrometres.
    assert shown.limit == pytest.approx(2e3 * np.nanstd(deviation), rel=1e-5) and shown.unit == "µm"
    found = json.loads(shown.to_json())
    stored = np.frombuffer(unpacked(found["data"]), np.uint8).reshape(4, 2, MOST_POINTS).astype(np.uint16)
    numbers = np.cumsum((stored[:, 0] | stored[:, 1] << 8).astype(np.int64), axis=1).astype(np.int16)
    values = np.where(numbers == -(2**15), np.nan, numbers * np.c_[found["step"]] + np.c_[found["offset"]])
    # Each range has 16382 steps; rounding is at most half a step.
    assert found["step"] == pytest.approx(
        np.nanmax(np.diff(np.nanquantile(values, [0, 1], axis=1), axis=0), axis=0) / 16382
    )
    for column, exact in zip(values, [*shown.points_mm.T, shown.values], strict=True):
        assert np.nanmax(np.abs(column - exact)) <= 0.5001 * np.ptp(exact[np.isfinite(exact)]) / 16382
        assert np.array_equal(np.isnan(column), np.isnan(exact))


def test_colours_are_symmetric_and_end_at_the_limit():
    shown = plot.DEVIATIONS(np.array([-2.0, 0.0, 0.5, 1.0, 4.0]))
    assert shown[0].tolist() == shown[1].tolist() and shown[3].tolist() == shown[4].tolist()
    assert shown[0][2] > shown[0][0] and shown[3][0] > shown[3][2] and np.ptp(shown[2, :3]) < 0.03
    assert colour_limit_mm(np.array([-0.01, 0.01, np.nan])) == pytest.approx(0.02)
    points, nothing = np.arange(9.0).reshape(3, 3), np.zeros(3, int)
    cloud = PointCloud(points, nothing, nothing, nothing, deviation_mm=np.array([-0.01, 0.01, np.nan]))
    unknown, known = plot.cloud(cloud).collections
    assert known.get_clim() == pytest.approx((-20, 20)) and sorted(known.get_array()) == pytest.approx([-10, 10])
    assert to_hex(unknown.get_facecolor()) == plot.UNKNOWN
    assert to_hex(plot.cloud(replace(cloud, deviation_mm=None)).collections[0].get_facecolor()) == plot.PLAIN


@settings(deadline=None)
@given(st.floats(min_value=-1e6, max_value=1e6), st.integers(0, 6), st.booleans())
def test_fixed_numbers_are_near_and_have_no_negative_zero(value, decimals, signed):
    text = format_fixed(value, decimals, signed=signed)
    # Half of the last decimal, and the rounding of a double near a million.
    assert abs(float(text) - value) <= 0.5 * 10**-decimals + 1e-9
    assert (text[0] in "+-") == (float(text) < 0 or (signed and float(text) > 0))


def test_numbers_have_the_decimals_of_their_scale():
    assert format_to_scale(0.123456, 0.158) == "0.12" and format_to_scale(7.0, 0.0) == "7.000"
    assert format_fixed(math.nan) == "-"
