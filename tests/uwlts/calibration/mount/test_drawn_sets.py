"""Mounts from sets that share nothing with the product: arcs among scattered points, and plain least squares."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import uwlts
from tests.oracles.profilers import Kind, draw_set
from tests.uwlts.drawn_mounts import SHORT_ARCS, differences, least_squares_mount, mount_of, rms_mm
from uwlts.errors import CalibrationError
from uwlts.shapes.profile_curves import find_arc


def test_plain_least_squares_finds_the_mount_of_perfect_sets():
    kinds: tuple[Kind, ...] = ("sphere", "plane")
    for kind in kinds:
        given = draw_set(3, kind, noise_mm=1e-6, smooth_mm=0.0, robot_mm=0.0, turn_rad=0.0, poses=24, points=200)
        mount, rms = least_squares_mount(given, size_known=True)
        # A micrometre divided by the sine of the steepest view, and less than that from 24 poses.
        assert rms < 3e-6 and np.abs(mount - given.mount).max() < 1e-5


@pytest.mark.parametrize("options", [{}, SHORT_ARCS, SHORT_ARCS | {"points": 600, "scattered": 0.4}])
@pytest.mark.parametrize("radius_known", [True, False])
def test_arcs_among_scattered_points_are_found(options, radius_known):
    """At most one arc in 30 is missed: those of less than 30 deg, about one in 100 drawn arcs."""
    found = wrong = count = 0
    for seed in (200, 201, 202):
        given = draw_set([seed, 0], "sphere", poses=16, **options)
        for profile, surface in zip(given.profiles, given.surface, strict=True):
            seen = np.isfinite(profile).all(axis=1)
            on = surface[seen] == 0
            arc = find_arc(profile[seen], given.size_mm if radius_known else None, np.random.default_rng(0))
            count += 1
            if arc is not None:
                own = np.count_nonzero(arc.members & on)
                right = own > 0.8 * on.sum() and np.count_nonzero(arc.members & ~on) < 0.1 * on.sum()
                found, wrong = found + right, wrong + (not right)
    assert count == 48 and found >= 46 and wrong == 0


def test_scattered_points_alone_are_rarely_an_arc(rng):
    found = 0
    for _ in range(40):
        depth = rng.uniform(150, 250, rng.choice([100, 300, 1000, 2000]))
        points = np.column_stack([np.tan(np.linspace(-0.3, 0.3, len(depth))) * depth, depth])
        found += find_arc(points, None, rng) is not None
    # One in ten, measured on 120 others; more than 13 of 40 once in 10,000 runs.
    assert found <= 13


def test_scattered_points_on_the_continuation_of_an_arc_are_left_out(rng):
    """Points on the rear of the circle, or 90 deg beyond the arc, fit it; they would shift it most."""
    angle = np.radians(np.linspace(60, 120, 200))
    points = 20 * np.column_stack([np.cos(angle), np.sin(angle)]) + 0.01 * rng.standard_normal((200, 2))
    rear, beside = [0.3, -20.0], [-20.0, 0.2]
    points = np.vstack([points[:90], rear, points[90:], beside])
    points[40:55] = np.nan
    points = points[np.isfinite(points).all(axis=1)]
    arc = find_arc(points, 20.0, rng)
    assert arc is not None
    left = replace(arc, members=np.ones(len(points), dtype=bool)).without_isolated(points)
    foreign = np.linalg.norm(points - [0, 20], axis=1) > 15
    assert foreign.sum() == 2 and not left.members[foreign].any() and left.members[~foreign].all()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(8)


CASES = [("sphere", True), ("sphere", False), ("plane", True)]


@pytest.mark.parametrize(
    ("kind", "size_known", "seed"),
    [("sphere", False, 300), *(pytest.param(*case, 301, marks=pytest.mark.slow) for case in CASES)],
)
def test_the_scatter_is_that_of_plain_least_squares(kind, size_known, seed):
    given = draw_set([seed, 1], kind)
    mount = mount_of(given, size_known=size_known)
    # Plain least squares has the smallest scatter by definition; weights that suit the errors add some per cent.
    assert rms_mm(given, mount) < 1.1 * least_squares_mount(given, size_known=size_known)[1]
    assert (np.abs(differences(mount.transform(), given.mount)) < 5 * mount.std()).all()


@pytest.mark.slow
def test_halves_agree_within_what_they_state():
    """The form error is the same in all profiles; halves cannot show it, but each must state its own scatter."""
    given = draw_set([310, 0], "sphere", poses=32, fixed_mm=0.03, **SHORT_ARCS)
    one, other = (mount_of(given.select(slice(k, None, 2))) for k in (0, 1))
    apart = differences(one.transform(), other.transform())
    spread = np.array(one.covariance) + np.array(other.covariance)
    assert apart @ np.linalg.solve(spread, apart) < chi2.isf(1e-4, 6)


def test_poses_that_do_not_belong_are_refused_quickly():
    """Poses in another order: once they took 60 rounds, twice; the limit is 4 times what a mount takes."""
    given = draw_set(4, "sphere", poses=16, points=300)
    begun = time.process_time()
    mount_of(given)
    usual, begun = time.process_time() - begun, time.process_time()
    with pytest.raises(CalibrationError, match="no mount fits|do not determine|does not converge|and agree"):
        uwlts.calibrate_mount(given.profiles, given.poses[::-1], radius_mm=given.size_mm)
    assert time.process_time() - begun < 4 * max(usual, 1.0)
