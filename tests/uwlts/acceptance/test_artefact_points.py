"""Points of artefacts chosen by geometry: form errors with flyers of drawn shares and sizes."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from uwlts.acceptance.characteristics import measure_plane, measure_spheres, measure_step_height
from uwlts.errors import EvaluationError
from uwlts.model.artefacts import PlaneStandard, SphereStandard, StepStandard

RADIUS_MM, NOISE_MM, LIMIT_MM, MARGIN_MM = 25.0, 0.012, 0.3, 5.0
SPHERE = SphereStandard(diameters_mm=(2 * RADIUS_MM,))
CENTRE = np.array([3.0, -8.0, 20.0])


def draw_sphere(rng, count, *, share, size_mm, start_mm=0.0):
    """Points of a cap of 70 deg with noise; a share is off by an even distance up to a size, to both sides.

    Returns the points, and their true distances from the surface.
    """
    z = 1 - rng.random(count) * (1 - np.cos(np.radians(70)))
    turn, across = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - z**2)
    off = rng.normal(0, NOISE_MM, count)
    wild = rng.permutation(count)[: round(share * count)]
    off[wild] = rng.choice([-1, 1], len(wild)) * rng.uniform(start_mm, size_mm, len(wild))
    way = np.column_stack([across * np.cos(turn), across * np.sin(turn), -z])
    return CENTRE + (RADIUS_MM + off)[:, None] * way, off


def fit_reference(points, off):
    """Return the range of distances and the diameter after leaving out the farthest 0.3 % from the true sphere."""
    kept = points[np.argsort(np.abs(off))[: len(points) - int(0.003 * len(points))]]
    fit = least_squares(lambda p: np.linalg.norm(kept - p[:3], axis=1) - p[3], [*CENTRE, RADIUS_MM])
    return np.ptp(fit.fun), 2 * fit.x[3]


@pytest.mark.parametrize("seed", range(12))
def test_flyers_count_in_the_form_error(seed):
    """Shares of 0 to 5 %, sizes of 0.2 to 4 mm: value and diameter are those of all points but the farthest 0.3 %."""
    rng = np.random.default_rng([58, seed])
    share, size = (0.0, 1.0) if seed == 0 else (10 ** rng.uniform(-3.3, -1.3), 10 ** rng.uniform(-0.7, 0.6))
    points, off = draw_sphere(rng, int(rng.integers(2000, 9000)), share=share, size_mm=size)
    (found,) = measure_spheres(points, SPHERE, margin_mm=MARGIN_MM)
    form, diameter = fit_reference(points, off)
    # The first fit orders the farthest points; it differs from the true sphere by less than the noise.
    assert found.range_mm == pytest.approx(form, abs=2 * NOISE_MM)
    assert 2 * found.fit.radius_mm == pytest.approx(diameter, abs=NOISE_MM)
    assert (found.points, found.rejected) == (len(points), int(0.003 * len(points)))
    # The decision is that of the drawn points: nothing beyond the limit disappears.
    if form > LIMIT_MM + 2 * NOISE_MM:
        assert found.range_mm > LIMIT_MM
    if share == 0:
        assert found.range_mm < 9 * NOISE_MM


def test_one_per_cent_of_flyers_up_to_a_millimetre_is_a_millimetre():
    points, _ = draw_sphere(np.random.default_rng(1), 6000, share=0.01, size_mm=1.0, start_mm=0.3)
    (found,) = measure_spheres(points, SPHERE, margin_mm=MARGIN_MM)
    assert 1.0 < found.range_mm < 2.0


@pytest.mark.parametrize("seed", range(4))
def test_more_than_the_permitted_share_beyond_the_margin_is_refused(seed):
    rng = np.random.default_rng([634, seed])
    for share, refused in ((0.002, False), (rng.uniform(0.005, 0.05), True)):
        points, _ = draw_sphere(rng, 5000, share=share, size_mm=2.8 * MARGIN_MM, start_mm=1.1 * MARGIN_MM)
        if refused:
            with pytest.raises(EvaluationError, match=r"sphere 1: \d+ of \d+ points .* permits leaving out 0.3 %"):
                measure_spheres(points, SPHERE, margin_mm=MARGIN_MM)
        else:
            (found,) = measure_spheres(points, SPHERE, margin_mm=MARGIN_MM)
            assert found.range_mm < 9 * NOISE_MM


def test_points_in_front_of_a_sphere_belong_to_it_at_any_distance():
    """Particles 10 to 100 mm before it are refused as its points; beside its outline they are of nothing."""
    rng = np.random.default_rng(6)
    points, _ = draw_sphere(rng, 4000, share=0.0, size_mm=0.0)
    turn, aside = rng.uniform(0, 2 * np.pi, 40), RADIUS_MM * np.sqrt(rng.random(40))
    particles = np.column_stack([aside * np.cos(turn), aside * np.sin(turn), -RADIUS_MM - rng.uniform(10, 100, 40)])
    with pytest.raises(EvaluationError, match="sphere 1: 40 of 4040 points"):
        measure_spheres(np.vstack([points, CENTRE + particles]), SPHERE, margin_mm=MARGIN_MM)
    beside = CENTRE + particles + [2 * RADIUS_MM + 1.0, 0, 0]
    (found,) = measure_spheres(np.vstack([points, beside]), SPHERE, margin_mm=MARGIN_MM)
    assert found.points == 4000


def test_other_surfaces_behind_and_beside_a_sphere_are_not_measurements_of_it():
    """A table behind, and another sphere whose region overlaps."""
    rng = np.random.default_rng(3)
    points, _ = draw_sphere(rng, 4000, share=0.0, size_mm=0.0)
    table = np.column_stack([rng.uniform(-90, 90, (3000, 2)), np.full(3000, CENTRE[2] + RADIUS_MM)])
    pair = SphereStandard(diameters_mm=(50.0, 50.0), spacings_mm=(52.0,))
    for found in measure_spheres(np.vstack([points, points + [0, 52.0, 0], table]), pair, margin_mm=MARGIN_MM):
        assert found.points == 4000
        assert found.range_mm < 9 * NOISE_MM


@pytest.mark.parametrize("seed", range(6))
def test_flyers_count_in_the_flatness_error(seed):
    rng = np.random.default_rng([26, seed])
    count, share, size = 5000, 10 ** rng.uniform(-3, -1.2), 10 ** rng.uniform(-0.5, 0.6)
    off = rng.normal(0, NOISE_MM, count)
    off[: round(share * count)] += rng.uniform(-size, size, round(share * count))
    points = np.column_stack([rng.uniform(-80, 80, (count, 2)), 10.0 + off])
    found = measure_plane(points, PlaneStandard(), margin_mm=MARGIN_MM)
    kept = np.sort(np.abs(off))[: count - int(0.003 * count)]
    assert kept[-1] - 3 * NOISE_MM < found.range_mm < 2 * kept[-1] + 3 * NOISE_MM
    points[: int(0.01 * count), 2] += 2 * MARGIN_MM
    with pytest.raises(EvaluationError, match="plane: "):
        measure_plane(points, PlaneStandard(), margin_mm=MARGIN_MM)


def test_form_errors_count_all_points():
    """The farthest 0.3 % are rejected for the range, and 95 % of all points count for the narrower one."""
    rng, offsets = np.random.default_rng(7), np.linspace(-1.0, 1.0, 1000)
    # Symmetric in X and Y, so that the offsets of four points together do not tilt the plane.
    first = rng.uniform(1, 50, (1000, 2))
    corners = np.vstack([first * sign for sign in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
    heights = np.tile(offsets, 4)
    heights[[0, 1000, 2000, 3000]], heights[[999, 1999, 2999, 3999]] = -30.0, 30.0
    found = measure_plane(np.column_stack([corners, heights]), PlaneStandard(), margin_mm=5.0)
    # 8 of 4000 points are outliers; 12 may be rejected, the outliers and 4 of the 8 at the ends of the rest.
    assert found.range_mm == pytest.approx(2.0, abs=0.01)
    assert found.range_95_mm == pytest.approx(0.95 * 2.0, abs=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_one_sided_flyers_on_a_step_move_its_height_by_their_mean(seed):
    """They are within a quarter of the height, so that no rule leaves them out."""
    rng = np.random.default_rng([12, seed])
    share, size, height = rng.uniform(0.005, 0.05), rng.uniform(0.5, 3.5), 20.0
    faces = []
    for y, level in ((2.0, 0.0), (-40.0, height)):
        off = rng.normal(0, NOISE_MM, 3000)
        wild = round(share * 3000)
        off[:wild] += size if level == 0.0 else 0.0
        faces.append(np.column_stack([rng.uniform(-20, 20, 3000), rng.uniform(y, y + 38, 3000), level + off]))
    points = np.vstack(faces)
    found = measure_step_height(points, np.arange(len(points)), StepStandard(height_mm=height))
    # The upper face is that at the smaller Z, without flyers; the other one is the mean of its own.
    assert found.height_mm == pytest.approx(
        height - share * size, abs=0.15 * share * size + 4 * NOISE_MM / np.sqrt(1500)
    )
