"""Snell's law at flat windows against Fermat's principle, the law's own invariants, and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings

from tests.oracles import fermat, optics
from tests.uwlts.drawn_windows import faces_and_indices, indices, seeds, tilted, tilts, windows
from uwlts.errors import RangeError
from uwlts.model.calibration import WindowModel
from uwlts.optics.window import RayStatus, refract, trace_window

AXIS = np.array([0.0, 0.0, 1.0])


def cone(seed: int, *, count: int = 40, largest_deg: float = 40.0) -> np.ndarray:
    """Unit vectors (count, 3) within an angle of the axis; the first runs along it, the second at the largest angle."""
    random = np.random.default_rng(seed)
    angle = math.radians(largest_deg) * np.sqrt(np.r_[0.0, 1.0, random.uniform(size=count - 2)])
    around = random.uniform(0, 2 * math.pi, count)
    return np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)


def plate(**changes: object) -> WindowModel:
    values = {"refractions": 2, "distance_mm": 62.8, "thickness_mm": 5.93, "glass_index": 1.52}
    return WindowModel(**values | changes)


@settings(deadline=None, max_examples=60)
@given(tilts, tilts, indices, indices, seeds)
def test_refraction_obeys_snell(x_deg, y_deg, n1, n2, seed):
    normal, incident = tilted(x_deg, y_deg), cone(seed)
    refracted, reflected = refract(incident, normal, ratio=n1 / n2)
    sine = np.linalg.norm(np.cross(incident, normal), axis=1)
    # Incidence reaches 60 deg: total reflection where n1 sin i > n2. Within rounding of the limit it may go either way.
    certain = np.abs(n1 * sine - n2) > 1e-12
    np.testing.assert_array_equal(reflected[certain], (n1 * sine > n2)[certain])
    assert np.isnan(refracted[reflected]).all()
    incident, refracted = incident[~reflected], refracted[~reflected]
    # The parts across the normal times indices up to 1.8, and the square of a unit vector: a few roundings of 2e-16.
    # The part along the normal may near grazing be wrong by sqrt(4e-16), but enters only squared, or not at all.
    across_in, across_out = (v - np.outer(v @ normal, normal) for v in (incident, refracted))
    np.testing.assert_allclose(n1 * across_in, n2 * across_out, rtol=0, atol=2e-15)
    np.testing.assert_allclose(np.einsum("ij,ij->i", refracted, refracted), 1.0, rtol=0, atol=4e-15)
    assert (refracted @ normal > 0).all()
    assert len(refracted) > 10


@settings(deadline=None, max_examples=40)
@given(tilts, tilts, indices, indices, seeds)
def test_refraction_is_reversible(x_deg, y_deg, n1, n2, seed):
    normal, incident = tilted(x_deg, y_deg), cone(seed)
    forth, reflected = refract(incident, normal, ratio=n1 / n2)
    # Without grazing rays: rounding errors of 1e-16 are divided by the cosine behind the interface, here above 0.1.
    kept = ~reflected
    kept[kept] = forth[kept] @ normal > 0.1
    back, _ = refract(-forth[kept], normal, ratio=n2 / n1)
    np.testing.assert_allclose(back, -incident[kept], rtol=0, atol=2e-14)
    assert kept.sum() > 10


def test_either_sense_of_the_normal_refracts_forwards_unlike_the_printed_equation():
    incident, ratio = cone(1, count=50), 1 / 1.33
    printed = ratio * incident + np.outer(
        ratio * -(incident @ AXIS) - np.sqrt(1 + ratio**2 * ((incident @ AXIS) ** 2 - 1)), AXIS
    )
    assert (printed[:, 2] < 0).all()
    forwards, _ = refract(incident, AXIS, ratio=ratio)
    assert (forwards[:, 2] > 0).all()
    np.testing.assert_array_equal(refract(incident, -AXIS, ratio=ratio)[0], forwards)


def test_each_ray_may_have_its_own_normal():
    incident = cone(2, count=30)
    normals = np.array([tilted(x, y) for x, y in np.random.default_rng(3).uniform(-20, 20, (30, 2))])
    together, _ = refract(incident, normals, ratio=1.2)
    alone = [refract(ray[None], normal, ratio=1.2)[0][0] for ray, normal in zip(incident, normals, strict=True)]
    # The scalar product may be summed in another order: roundings of numbers up to 1.
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-15)


def test_total_reflection_begins_at_the_critical_angle():
    critical = math.asin(1 / 1.5)
    angle = np.array([critical - 1e-9, critical + 1e-9])
    rays = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    refracted, reflected = refract(rays, AXIS, ratio=1.5)
    assert reflected.tolist() == [False, True]
    assert np.isfinite(refracted[0]).all() and np.isnan(refracted[1]).all()


@settings(deadline=None, max_examples=60)
@given(windows, indices, seeds)
def test_traced_rays_are_the_paths_of_least_time(window, medium_index, seed):
    seen = cone(seed)
    rays = trace_window(seen, window, medium_index=medium_index)
    assert (rays.status == RayStatus.OK).all()
    depth = np.random.default_rng(seed).uniform(10.0, 500.0, len(seen))
    points = rays.origins + depth[:, None] * rays.directions
    faces, path = faces_and_indices(window, medium_index)
    # Rounding errors of 1e-16 for lengths up to 1e3 mm are 1e-13 mm, divided by the squared cosine of 60 deg 1e-12 mm.
    # The oracle stops at steps of 1e-11 mm and converges quadratically. The tolerance is a thousand times larger.
    crossings = fermat.least_time_crossings(np.zeros(3), points, faces, path)
    np.testing.assert_allclose(rays.origins, crossings[:, -1], rtol=0, atol=1e-9)
    # The first leg is 5 mm or longer: 1e-12 mm over 5 mm.
    np.testing.assert_allclose(fermat.directions_seen(points, faces, path), seen, rtol=0, atol=1e-12)


@settings(deadline=None, max_examples=15)
@given(windows, indices, seeds)
def test_traced_rays_meet_a_plane_where_the_oracle_finds_the_point_seen(window, medium_index, seed):
    seen = cone(seed, count=15, largest_deg=30.0)
    rays = trace_window(seen, window, medium_index=medium_index)
    plane = fermat.Face(window.distance_mm * AXIS + 400.0 * AXIS, tilted(15.0, -10.0))
    length = ((plane.point - rays.origins) @ plane.normal) / (rays.directions @ plane.normal)
    assert (length > 10.0).all()
    points = rays.origins + length[:, None] * rays.directions
    faces, path = faces_and_indices(window, medium_index)
    guess = np.tile(plane.point, (len(seen), 1))
    found = fermat.points_seen_on_plane(seen, plane, guess, faces, path)
    # The oracle's search stops at moves of 3e-11 mm.
    np.testing.assert_allclose(points, found, rtol=0, atol=1e-9)


@settings(deadline=None, max_examples=30)
@given(windows, indices, seeds)
def test_a_plate_without_thickness_or_without_glass_is_one_refraction(window, medium_index, seed):
    seen = cone(seed)
    single = window.model_copy(update={"refractions": 1})
    thin = window.model_copy(update={"refractions": 2, "thickness_mm": 0.0})
    airy = window.model_copy(update={"refractions": 2, "glass_index": 1.0})
    farther = window.distance_mm + window.thickness_mm / window.normal[2]
    behind = single.model_copy(update={"distance_mm": farther})
    for plate_like, interface in ((thin, single), (airy, behind)):
        two = trace_window(seen, plate_like, medium_index=medium_index)
        one = trace_window(seen, interface, medium_index=medium_index)
        # Rounding errors of a few operations on lengths up to 1e3 mm and unit vectors; 1 / cos 60 deg doubles them.
        np.testing.assert_allclose(two.origins, one.origins, rtol=0, atol=1e-11)
        np.testing.assert_allclose(two.directions, one.directions, rtol=0, atol=1e-14)


@settings(deadline=None, max_examples=30)
@given(windows, seeds)
def test_in_air_a_plate_only_shifts_the_rays(window, seed):
    window, seen = window.model_copy(update={"refractions": 2}), cone(seed)
    rays = trace_window(seen, window, medium_index=1.0)
    # Both faces' roundings (1e-16), divided by cos 60 deg.
    np.testing.assert_allclose(rays.directions, seen, rtol=0, atol=2e-15)
    incidence = np.arccos(np.clip(seen @ np.array(window.normal), -1, 1))
    inside = np.arcsin(np.sin(incidence) / window.glass_index)
    shift = window.thickness_mm * np.sin(incidence - inside) / np.cos(inside)
    measured = np.linalg.norm(np.cross(rays.origins, seen), axis=1)
    # arccos near 0 turns a rounding of 1e-16 into 1.5e-8 rad, and so 20 mm * 1.5e-8 * (1 - 1/n) mm.
    np.testing.assert_allclose(measured, shift, rtol=0, atol=3e-7)


def test_in_air_a_single_interface_and_no_window_change_nothing():
    seen = cone(5)
    rays = trace_window(seen, plate(refractions=1), medium_index=1.0)
    np.testing.assert_allclose(rays.directions, seen, rtol=0, atol=1e-15)
    # On the ray through the pupil: roundings of 82 mm.
    np.testing.assert_allclose(np.cross(rays.origins, seen), 0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rays.origins[:, 2], 62.8, rtol=1e-15)
    bare = trace_window(seen, None, medium_index=1.33)
    np.testing.assert_array_equal(bare.directions, seen)
    np.testing.assert_array_equal(bare.origins, 0)


def test_the_sense_and_length_of_the_windows_normal_do_not_matter():
    normal = tilted(10.0, -5.0)
    forth = trace_window(cone(6), plate(normal=tuple(normal)), medium_index=1.33)
    back = trace_window(cone(6), plate().model_copy(update={"normal": tuple(-2.0 * normal)}), medium_index=1.33)
    np.testing.assert_allclose(back.origins, forth.origins, rtol=0, atol=1e-13)
    np.testing.assert_allclose(back.directions, forth.directions, rtol=0, atol=1e-15)


def test_each_failure_has_its_status_and_no_numbers():
    sideways = np.array([1.0, 0.0, 0.0])
    rays = np.stack([AXIS, sideways, [math.sin(1.2), 0.0, math.cos(1.2)], [np.nan, 0.0, 1.0]])
    before = rays.copy()
    # A medium of index 0.5 totally reflects beyond 30 deg; 1.2 rad are 69 deg.
    traced = trace_window(rays, plate(), medium_index=0.5)
    expected = [RayStatus.OK, RayStatus.BEHIND_WINDOW, RayStatus.TOTAL_REFLECTION, RayStatus.NO_DIRECTION]
    assert traced.status.tolist() == expected
    assert traced.status.dtype == np.uint8
    assert np.isfinite(traced.origins[0]).all() and np.isfinite(traced.directions[0]).all()
    assert np.isnan(traced.origins[1:]).all() and np.isnan(traced.directions[1:]).all()
    np.testing.assert_array_equal(rays, before)
    bare = trace_window(rays, None, medium_index=1.0)
    assert bare.status.tolist() == [RayStatus.OK, RayStatus.OK, RayStatus.OK, RayStatus.NO_DIRECTION]
    assert np.isnan(bare.origins[3]).all() and np.isnan(bare.directions[3]).all()


def test_no_rays_are_no_error():
    traced = trace_window(np.empty((0, 3)), plate(), medium_index=1.33)
    assert traced.origins.shape == traced.directions.shape == (0, 3)


@pytest.mark.parametrize("value", [0.0, -1.33, math.nan, math.inf])
def test_impossible_indices_are_refused(value):
    with pytest.raises(RangeError, match="medium_index"):
        trace_window(cone(1), plate(), medium_index=value)
    with pytest.raises(RangeError, match="ratio"):
        refract(cone(1), AXIS, ratio=value)


def test_a_window_along_the_axis_is_refused():
    with pytest.raises(RangeError, match="normal"):
        trace_window(cone(1), plate(normal=(1.0, 0.0, 0.0)), medium_index=1.33)


@settings(deadline=None, max_examples=40)
@given(indices, indices)
def test_the_fresnel_oracle_keeps_the_energy_and_the_known_values(n1, n2):
    cosine = np.linspace(0.01, 1.0, 100)
    reflected, transmitted = optics.fresnel_powers(cosine, n1=n1, n2=n2)
    # Two numbers below 1 from 2x2 systems; at a cosine of 0.01 their condition is about a hundred.
    np.testing.assert_allclose(reflected + transmitted, 1.0, rtol=0, atol=1e-13)
    straight = 1 - ((n1 - n2) / (n1 + n2)) ** 2
    np.testing.assert_allclose(optics.fresnel_transmittance(1.0, n1=n1, n2=n2), straight, rtol=1e-14)
    # Brewster's angle, tan = n2 / n1: no reflection in p. The power is the square of an amplitude of rounding size.
    brewster = optics.fresnel_powers(math.cos(math.atan(n2 / n1)), n1=n1, n2=n2)[0]
    assert brewster[1] < 1e-28


def test_the_fresnel_oracle_reflects_all_beyond_the_critical_angle():
    beyond = math.cos(math.asin(1 / 1.5) + 0.01)
    reflected, transmitted = optics.fresnel_powers(beyond, n1=1.5, n2=1.0)
    np.testing.assert_allclose(reflected, 1.0, rtol=1e-14)
    assert (transmitted < 1e-15).all()


def test_the_least_time_oracle_beats_every_other_path():
    faces = fermat.plate(distance=60.0, thickness=6.0, normal=tilted(12.0, -7.0))
    path, end = [1.0, 1.52, 1.33], np.array([[80.0, -50.0, 400.0]])
    best = fermat.least_time_crossings(np.zeros(3), end, faces, path)[0]

    def optical_length(crossings: np.ndarray) -> float:
        corners = np.vstack([np.zeros(3), crossings, end])
        return float(np.linalg.norm(np.diff(corners, axis=0), axis=1) @ path)

    for face, crossing in zip(faces, best, strict=True):
        assert abs((crossing - face.point) @ face.normal) < 1e-12
    random = np.random.default_rng(7)
    for _ in range(200):
        moved = best + np.stack([face.basis() @ random.normal(scale=0.1, size=2) for face in faces])
        assert optical_length(moved) > optical_length(best)
