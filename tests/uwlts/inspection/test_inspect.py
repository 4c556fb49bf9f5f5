"""Inspections of simulated scans with known shape in closed form and errors as stated in the clouds.

Gates on values are 4.5 standard uncertainties, exceeded by a normal error 7 times in a million. Gates on counts state
their probability of a false alarm.
"""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import uwlts
from uwlts.cli import app
from uwlts.errors import EvaluationError
from uwlts.inspection.bell_maps import UnrolledSurface
from uwlts.inspection.blemish_search import search_blemishes
from uwlts.inspection.features import DEFINITIONS, FeatureKind
from uwlts.inspection.pipe_form import PipeFormRule, fit_pipe, pipe_features
from uwlts.inspection.weld import _find_toes
from uwlts.report.findings_page import inspect_cloud
from uwlts.shapes.flat import Circle
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PAIRS, PointCloud, PointUncertainty, make_foreign_cloud

NOISE_MM, IMAGE_MM = 0.02, 0.004
RADIUS_MM = 150.0
GATE = 4.5


def cloud_of(rng, points, normals, frame, line, *, patterns=(), stated=True, correlated=False):
    """Return a cloud with noise along the normals, offsets of images and common patterns (N, 3), as it states them."""
    count = len(points)
    noise = NOISE_MM * rng.standard_normal(count)
    if correlated:
        # Neighbours along the stripe share a third of their noise's variance each.
        drawn = rng.standard_normal(count + 2)
        noise = NOISE_MM * (drawn[:-2] + drawn[1:-1] + drawn[2:]) / np.sqrt(3)
    position = np.zeros((count, 3))
    position[:, 2] = IMAGE_MM
    common = np.array(patterns) if len(patterns) else np.zeros((1, count, 3))
    moves = noise[:, None] * normals + rng.standard_normal(frame.max() + 1)[frame][:, None] * position
    moves = moves + np.tensordot(rng.standard_normal(len(common)), common, axes=1)
    random = NOISE_MM**2 * np.stack([normals[:, i] * normals[:, j] for i, j in PAIRS], axis=1)
    known = PointUncertainty(*(each.astype(np.float32) for each in (random, position, common))) if stated else None
    return PointCloud(points + moves, np.ones(count), frame, line, uncertainty=known)


def pipe_scan(rng, *, half_arc=np.pi, along=(-20, 20.5, 1.0), around_mm=0.8, radius=None, **options):
    """Scan a pipe along x about the origin; its radius (N,) is a function of x and of the angle from -z towards y."""
    x = np.arange(*along)
    angle = np.linspace(-half_arc, half_arc, int(2 * half_arc * RADIUS_MM / around_mm), endpoint=False)
    at, turn = (each.ravel() for each in np.meshgrid(x, angle, indexing="ij"))
    frame, line = (each.ravel() for each in np.meshgrid(np.arange(len(x)), np.arange(len(angle)), indexing="ij"))
    normals = np.column_stack([np.zeros(len(at)), np.sin(turn), -np.cos(turn)])
    size = np.full(len(at), RADIUS_MM) if radius is None else radius(at, turn)
    points = size[:, None] * normals
    points[:, 0] = at
    points[:, 2] += 0.002 * np.square(at) * options.pop("bow", 0.0)
    # Scale, and a shift that varies along the stripe: typical errors of a calibration.
    patterns = [2e-5 * points, 0.01 * np.sin(turn / 2)[:, None] * normals]
    return cloud_of(rng, points, normals, frame, line, patterns=patterns, **options)


def test_fits_that_do_not_settle_are_errors(monkeypatch):
    """A pipe of 1.5 mm ovality seen from one side, in one round; and a circle through collinear places."""
    cloud = pipe_scan(
        np.random.default_rng(2),
        radius=lambda x, angle: RADIUS_MM * (1 + 0.0025 * np.cos(2 * angle - 0.6)),
        half_arc=1.2,
        around_mm=3.0,
    )
    assert fit_pipe(cloud).radius_mm == pytest.approx(RADIUS_MM, abs=1.0)
    monkeypatch.setattr("uwlts.inspection.pipe_form.FORM_RULE", PipeFormRule(rounds=1))
    with pytest.raises(EvaluationError, match="axis does not converge: after 1 rounds it still changes by"):
        fit_pipe(cloud)
    places = np.array([[0.0, 0.0], [1.0, 1e-12], [2.0, -1e-12], [3.0, 0.0]])
    with pytest.raises(EvaluationError, match="no circle fits the 4 points"):
        Circle.fit(places)


def test_the_form_of_a_pipe_is_within_its_intervals():
    """20 pipes; fewer than 14 of 20 intervals of 95 % contain the truth 3 times in 100,000."""

    def oval(x, angle):
        bow = 3e-4 * np.square(x) * np.sin(angle)
        return RADIUS_MM * (1 + 0.0025 * np.cos(2 * (angle - 0.3))) + 0.05 * np.cos(3 * angle) + bow

    rng = np.random.default_rng(1)
    truth = {"diameter": 300.0, "ovality": 1.5, "ovality share": 0.5, "straightness": np.hypot(1e-3, 3e-4) * 20.0**2}
    truth |= {"axis slope 1": 0.0, "axis slope 2": 0.0}
    inside = dict.fromkeys(truth, 0)
    for _ in range(20):
        cloud = pipe_scan(rng, radius=oval, bow=0.5, along=(-20, 20.5, 2.0), around_mm=3.0, correlated=True)
        pipe, *sections = pipe_features(cloud, fit_pipe(cloud))[0]
        for name, value in truth.items():
            inside[name] += pipe[name].low <= value <= pipe[name].high
        assert pipe["ovality"].uncertainty < 0.03
    assert min(inside.values()) >= 14, inside
    assert len(sections) == 12
    # The length from -20 to 20 mm in twelve parts, about an axis through the origin, which is bowed along y and z.
    middles = (np.arange(12) + 0.5) * 40 / 12 - 20
    squares = np.square(middles) + (40 / 12) ** 2 / 12
    places = np.array(sorted((section.place_mm for section in sections), key=lambda place: place[0]))
    np.testing.assert_allclose(places, np.column_stack([middles, 3e-4 * squares, 1e-3 * squares]), atol=0.03)
    for section in sections:
        assert section["ovality"].value == pytest.approx(1.5, abs=GATE * section["ovality"].uncertainty + 0.05)


def test_the_diameter_of_an_arc_may_be_that_of_an_oval():
    """Any ovality up to 2 %; fewer than 14 of 20 intervals of 95 % contain the truth 3 times in 100,000.

    Sections of a pipe share its ovality, so that one section per pipe is counted.
    """
    rng = np.random.default_rng(14)
    inside = np.zeros(2, int)
    for _ in range(20):
        amplitude, turn = rng.uniform(0, 0.02) * RADIUS_MM / 2, rng.uniform(0, np.pi)

        def oval(x, angle, amplitude=amplitude, turn=turn):
            return RADIUS_MM + amplitude * np.cos(2 * (angle - turn))

        cloud = pipe_scan(rng, half_arc=np.pi / 4, along=(-20, 20.5, 2.0), around_mm=3.0, radius=oval)
        pipe, section, *_ = pipe_features(cloud, fit_pipe(cloud))[0]
        values = pipe["diameter"], section["diameter"]
        assert values[0].uncertainty < 4.0
        inside += [value.low <= 300.0 <= value.high for value in values]
    assert inside.min() >= 14, inside
    # For a pipe known to be round only the points' own uncertainty remains.
    round_one = pipe_features(cloud, fit_pipe(cloud, largest_ovality=0.0))[0][0]["diameter"]
    assert round_one.uncertainty < 0.1 * values[0].uncertainty


@pytest.mark.slow
def test_a_round_pipe_may_be_round():
    """The ovality's interval contains zero in nine of ten cases (13 or fewer of 20: 3 in 100,000)."""
    rng = np.random.default_rng(2)
    lows = []
    for _ in range(20):
        cloud = pipe_scan(rng, along=(-20, 20.5, 2.0), around_mm=3.0)
        lows.append(pipe_features(cloud, fit_pipe(cloud))[0][0]["ovality"].low)
    assert np.count_nonzero(np.array(lows) == 0) >= 14


def field(rng, *, side=50.0, step=0.5, heights=None, correlated=True):
    """Return an unrolled surface whose noise is correlated between neighbours along the second axis."""
    u, v = np.meshgrid(np.arange(0, side, step), np.arange(0, side, 0.25), indexing="ij")
    drawn = rng.standard_normal((u.shape[0], u.shape[1] + 2))
    noise = (drawn[:, :-2] + drawn[:, 1:-1] + drawn[:, 2:]) / np.sqrt(3) if correlated else drawn[:, 2:]
    shape = 0.0 if heights is None else heights(u, v)
    values = (shape + NOISE_MM * noise).ravel()
    return UnrolledSurface(
        np.column_stack([u.ravel(), v.ravel()]), values, np.full(u.size, NOISE_MM), np.zeros((u.size, 2))
    )


@pytest.mark.slow
def test_false_alarms_are_as_rare_as_stated():
    """20 undamaged surfaces at a probability of 0.2 each give 12 or more indications once in 10,000 times."""
    rng = np.random.default_rng(3)
    alarms = [len(search_blemishes(field(rng, correlated=k % 2 == 0), false_alarm=0.2).indications) for k in range(20)]
    assert np.count_nonzero(alarms) < 12


def test_outliers_and_holes_are_no_blemishes():
    rng = np.random.default_rng(4)
    surface = field(rng)
    spoilt = surface.heights.copy()
    wild = rng.choice(len(spoilt), 150, replace=False)
    spoilt[wild] -= rng.uniform(0.5, 5, 150)
    seen = np.hypot(*(surface.places - 25).T) > 6
    search = search_blemishes(
        UnrolledSurface(surface.places[seen], spoilt[seen], surface.std[seen], surface.footprint_mm[seen]),
        false_alarm=1e-3,
    )
    assert not search.indications
    kept = np.isin(np.flatnonzero(seen), wild)
    # Among ten thousand points, two neighbouring outliers may hide each other.
    assert search.outliers[kept].mean() > 0.9 and search.outliers[~kept].mean() < 0.02


def bell(u, v, at, diameter, depth):
    return -depth * np.square(np.maximum(1 - ((u - at[0]) ** 2 + (v - at[1]) ** 2) / (diameter / 2) ** 2, 0))


def small_pipe(mm_per_unit=1.0):
    """Return a cloud of a pipe of 60 mm radius without uncertainties, in any unit."""
    rng = np.random.default_rng(6)
    u, angle = rng.uniform(0, 100, 4000), rng.uniform(-1.2, 1.2, 4000)
    points = np.column_stack([u, 60 * np.sin(angle), 400 - 60 * np.cos(angle)]) + rng.normal(0, 0.02, (4000, 3))
    return make_foreign_cloud(points / mm_per_unit)


@pytest.mark.parametrize(
    ("mm_per_unit", "wall_mm", "message"),
    [
        (1000.0, 9.0, r"0.\d+ mm and a wall of 9 mm.*seem to be in m$"),
        (1000.0, None, "impossible.*seem to be in m$"),
        (25.4, 9.0, "seem to be in cm or inches"),
        (10.0, 9.0, "seem to be in cm or inches"),
    ],
)
def test_a_pipe_in_other_units_is_refused(mm_per_unit, wall_mm, message):
    cloud = small_pipe(mm_per_unit)
    with pytest.raises(uwlts.Error, match=message):
        uwlts.inspect_pipe(cloud, wall_mm=wall_mm)


def test_an_unusually_thick_wall_is_noted():
    for wall_mm in (9.0, 30.0):
        notes = uwlts.inspect_pipe(small_pipe(), wall_mm=wall_mm).notes
        assert any("unusually thick" in note for note in notes) == (wall_mm == 30.0)


def test_pits_are_found_and_measured():
    """Pits, one next to a much larger one, and a protrusion, on an eighth of the circumference of an oval pipe."""
    places = {(-10.0, -40.0): (3.0, 0.3), (0.0, 5.0): (18.0, 3.0), (8.0, -20.0): (8.0, 0.8), (-9.0, 40.0): (6.0, -0.5)}
    places[(-12.0, 9.0)] = (4.0, 0.4)

    def radius(x, angle):
        shape = RADIUS_MM * (1 + 0.0025 * np.cos(2 * angle))
        return shape + sum(bell(x, RADIUS_MM * angle, at, *size) for at, size in places.items())

    rng = np.random.default_rng(5)
    cloud = pipe_scan(rng, half_arc=0.4, along=(-24, 24, 0.5), around_mm=0.3, radius=radius, correlated=True)
    found = uwlts.inspect_pipe(cloud, wall_mm=9.0)
    assert any("deg of the circumference" in note and "ovality of up to 2 %" in note for note in found.notes)
    assert not any("no uncertainty" in note for note in found.notes)
    blemishes = found.select(FeatureKind.PIT, FeatureKind.DENT, FeatureKind.PROTRUSION)
    assert len(blemishes) == len(places)
    # Numbers descend with depth, by kind.
    pits = [feature.values[0].value for feature in found.select(FeatureKind.PIT)]
    assert pits == sorted(pits, reverse=True) and [feature.name for feature in found.select(FeatureKind.PIT)] == [
        f"pit {number}" for number in range(1, 5)
    ]
    for feature in blemishes:
        x, y, z = feature.place_mm
        at = min(places, key=lambda place: np.hypot(place[0] - x, place[1] - RADIUS_MM * np.arctan2(y, -z)))
        diameter, depth = places.pop(at)
        assert np.hypot(at[0] - x, at[1] - RADIUS_MM * np.arctan2(y, -z)) < 0.5 + 0.05 * diameter
        value = feature.values[0]
        assert feature.kind == (FeatureKind.PIT if depth > 0 else FeatureKind.PROTRUSION)
        assert value.value == pytest.approx(abs(depth), abs=GATE * value.uncertainty)
        assert value.uncertainty < 0.05 and feature.false_alarm < 0.05
        edge = feature["edge depth"].value / abs(depth)
        across = diameter * np.sqrt(1 - np.sqrt(edge))
        for name in ("length", "width"):
            # The local quadratic blurs the contour by a part of the points' spacing.
            assert feature[name].value == pytest.approx(across, abs=GATE * feature[name].uncertainty + 0.25)
        if depth > 0:
            assert feature["remaining wall"].value == pytest.approx(9.0 - value.value)
        towards = feature.axes @ [0.0, y, z] / np.hypot(y, z)
        assert towards == pytest.approx([0, 0, 1], abs=0.01)
    deepest = cloud.points_mm[np.nanargmin(found.deviation_mm)]
    assert np.hypot(deepest[0], deepest[1] - 5) < 3


def test_a_pit_where_a_whole_pipe_is_cut_open_is_found_once():
    """Pits at eight angles around the pipe, so that some are in the overlap of both sides of any cut."""
    turns = np.linspace(-np.pi, np.pi, 8, endpoint=False)

    def radius(x, angle):
        away = [np.mod(angle - turn + np.pi, 2 * np.pi) - np.pi for turn in turns]
        return RADIUS_MM + sum(bell(x, RADIUS_MM * each, (0.0, 0.0), 20.0, 1.0) for each in away)

    cloud = pipe_scan(np.random.default_rng(13), radius=radius, along=(-20, 20.5, 2.0), around_mm=2.0)
    pits = uwlts.inspect_pipe(cloud).select(FeatureKind.PIT)
    angles = np.sort([np.arctan2(pit.place_mm[1], -pit.place_mm[2]) for pit in pits])
    assert len(pits) == 8
    assert np.diff(angles) == pytest.approx(np.full(7, np.pi / 4), abs=0.02)
    for pit in pits:
        within(pit, {"depth": 1.0})


@pytest.mark.slow
def test_depths_are_within_their_intervals():
    """36 pits of 1 mm depth; fewer than 27 of 36 intervals of 95 % contain the truth once in 100,000 times."""
    places = list(product(np.arange(-20, 21, 8.0), np.arange(-20, 21, 8.0)))

    def radius(x, angle):
        return RADIUS_MM + sum(bell(x, RADIUS_MM * angle, at, 5.0, 1.0) for at in places)

    cloud = pipe_scan(np.random.default_rng(6), half_arc=0.2, along=(-25, 25, 0.5), around_mm=0.25, radius=radius)
    pits = uwlts.inspect_pipe(cloud).select(FeatureKind.PIT)
    assert len(pits) == len(places)
    assert np.count_nonzero([pit["depth"].low <= 1.0 <= pit["depth"].high for pit in pits]) >= 27
    # Errors common to all points are equal in a pit and its surroundings.
    assert all(pit["depth"].systematic < 0.2 * pit["depth"].random for pit in pits)


@pytest.mark.slow
def test_what_the_footprint_of_points_smooths_is_put_back():
    """25 pits of 2.5 mm diameter and 0.5 mm depth; without the footprint correction they are a tenth too shallow."""
    sizes, places = (0.22, 0.2), list(product(np.arange(-12, 13, 6.0), np.arange(-12, 13, 6.0)))
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)

    def radius(x, angle):
        result = np.full(np.shape(x), RADIUS_MM)
        for (a, wa), (b, wb) in product(zip(nodes, weights, strict=True), repeat=2):
            seen = x + a * sizes[0], RADIUS_MM * angle + b * sizes[1]
            result = result + wa * wb / (2 * np.pi) * sum(bell(*seen, at, 2.5, 0.5) for at in places)
        return result

    cloud = pipe_scan(np.random.default_rng(15), half_arc=0.12, along=(-16, 16, 0.4), around_mm=0.15, radius=radius)
    known = replace(cloud, metadata={FOOTPRINT: list(sizes), FOOTPRINT_STD: 0.2})
    means = []
    for each in (cloud, known):
        pits = uwlts.inspect_pipe(each).select(FeatureKind.PIT)
        assert len(pits) == len(places)
        means.append(np.mean([pit["depth"].value for pit in pits]))
    inside = [pit["depth"].low <= 0.5 <= pit["depth"].high for pit in pits]
    # Fewer than 18 of 25 intervals of 95 % contain the truth once in 10,000 times.
    assert np.count_nonzero(inside) >= 18
    assert means[0] < 0.475 < 0.485 < means[1] < 0.515


def flat_scan(rng, height, kept, *, along=(-30, 30, 0.5), across=(-60, 60, 900), **options):
    """Scan a flat object facing -z along x, in profiles across it; ``kept`` selects places with a surface."""
    x, y = np.arange(*along), np.linspace(*across)
    at, over = np.meshgrid(x, y, indexing="ij")
    frame, line = np.meshgrid(np.arange(len(x)), np.arange(len(y)), indexing="ij")
    seen = kept(at, over)
    at, over, frame, line = at[seen], over[seen], frame[seen], line[seen]
    points = np.column_stack([at, over, -height(at, over)])
    normals = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    patterns = [1e-4 * points, 2e-4 * np.column_stack([0 * at, 0 * at, over])]
    return cloud_of(rng, points, normals, frame, line, patterns=patterns, **options)


def everywhere(x, y):
    return np.ones(np.shape(x), bool)


def within(feature, truth):
    """Assert that each value of a feature is within the gate of the truth."""
    for name, value in truth.items():
        assert feature[name].value == pytest.approx(value, abs=GATE * feature[name].uncertainty), name


def weld_height(x, y, *, undercut, offset):
    """Return a bead (1 - t^2)^2 of 2 mm and 12 mm on plates with an offset, with grooves of 2.4 mm at its toes."""
    t = np.abs(y) / 6
    bead = 2.0 * np.square(np.maximum(1 - np.square(t), 0))
    groove = undercut * np.square(np.maximum(1 - np.square((t - 1) * 6 / 1.2), 0))
    return bead - groove + offset * np.clip(y / 12 + 0.5, 0, 1)


def weld_scan(seed, *, undercut=0.0, offset=0.0, along=(-15, 15, 1.0), across=(-40, 40, 400)):
    """Scan a weld in profiles 1 mm apart, whose points are 0.2 mm apart."""
    rng = np.random.default_rng(seed)
    return flat_scan(
        rng, lambda x, y: weld_height(x, y, undercut=undercut, offset=offset), everywhere, along=along, across=across
    )


@pytest.mark.parametrize(("undercut", "offset"), [(0.4, 0.0), (0.0, 0.6)], ids=["undercut", "misaligned"])
def test_a_weld_is_measured(undercut, offset):
    weld = uwlts.inspect_weld(weld_scan(10, undercut=undercut, offset=offset)).features[0]
    within(weld, {"height": 2.0, "misalignment": offset})
    if undercut:
        within(weld, dict.fromkeys(("undercut left", "undercut right", "largest undercut"), undercut))
    else:
        assert max(weld["undercut left"].value, weld["undercut right"].value) < 2 * NOISE_MM
        # From 10 to 50 % of the height the flank's slope is 0.8 mm over (0.827 - 0.541) of 6 mm.
        angle = 180 - np.degrees(np.arctan(0.8 / (6 * (np.sqrt(1 - np.sqrt(0.1)) - np.sqrt(1 - np.sqrt(0.5))))))
        assert weld["toe angle left"].value == pytest.approx(angle, abs=1.0)
        assert weld["toe angle right"].value == pytest.approx(angle, abs=1.0)
    assert np.abs(weld.axes[0]) == pytest.approx([1, 0, 0], abs=0.02)


@pytest.mark.parametrize("undercut", [0.0, 0.1, 0.8])
def test_undercuts_of_few_points_across_are_within_their_intervals(undercut):
    """The 160 points of a profile are 0.5 mm apart: smoothing lowers the groove of 0.8 mm by 0.05 mm."""
    weld = uwlts.inspect_weld(weld_scan(12, undercut=undercut, across=(-40, 40, 160))).features[0]
    for name in ("undercut left", "undercut right", "largest undercut"):
        assert weld[name].low <= undercut <= weld[name].high, weld[name]


def test_a_weld_of_few_profiles_far_apart_is_refused():
    """Sections of 3 mm with profiles 4 mm apart: many have no points, and no strip along the weld has 50."""
    cloud = weld_scan(10, undercut=0.1, along=(-12, 13, 4.0), across=(-40, 40, 300))
    with pytest.raises(EvaluationError, match="points of complete sections, .* scan with profiles closer together"):
        uwlts.inspect_weld(cloud)


@pytest.mark.slow
def test_noise_does_not_raise_a_bead_on_average():
    """The mean of eight draws of 0.003 mm is within 4.5 deviations of 0.001 mm, and the correction of 0.005 mm once."""
    heights = [uwlts.inspect_weld(weld_scan(seed)).features[0]["height"].value for seed in range(20, 28)]
    assert np.mean(heights) == pytest.approx(2.0, abs=0.006)


def test_a_weld_of_many_even_profiles_is_measured_and_what_is_left_out_is_named():
    """More points on the bead than a square matrix of them would fit in memory, all on the same few lines.

    A shorter bead is next to it, and a tenth of the bead is missing.
    """

    def height(x, y):
        second = 2.0 * np.square(np.maximum(1 - np.square((y - 30) / 4), 0)) * (np.abs(x) < 10)
        return weld_height(x, y, undercut=0.0, offset=0.0) * (np.abs(x - 20) > 3) + second

    cloud = flat_scan(np.random.default_rng(17), height, everywhere, along=(-30, 30, 0.3), across=(-40, 40, 500))
    found = uwlts.inspect_weld(cloud)
    within(found.features[0], {"height": 2.0})
    assert found.features[0].extent_mm[0] > 55
    assert any(note.startswith("1 other beads") for note in found.notes)
    number = next(int(note.split()[0]) for note in found.notes if "sections are omitted" in note)
    assert number == pytest.approx(10, abs=3)


def test_what_stands_at_the_rim_of_a_section_is_not_its_top():
    """Few sections, one of them with a point higher than the bead at the end of its grid."""
    grid = np.linspace(-12.0, 12.0, 97)
    profile = weld_height(0.0, grid, undercut=0.0, offset=0.0)
    profile[-3:] = 5.0
    profiles = SimpleNamespace(across_mm=grid)
    left, right, *slopes = _find_toes(SimpleNamespace(profiles=profiles, half_mm=6.0), profile[None], np.array([0]))[0]
    assert right == pytest.approx(-left, abs=1e-9) and 4.0 < right < 6.0
    assert slopes[0] == pytest.approx(slopes[1])


def test_clouds_without_covariance_say_so(tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(11)
    options = {"half_arc": 0.3, "along": (-12, 12, 0.5), "around_mm": 0.4, "stated": False}
    cloud = pipe_scan(rng, radius=lambda x, a: RADIUS_MM + bell(x, RADIUS_MM * a, (0, 0), 6.0, 0.6), **options)
    cloud.save(tmp_path / "pipe.ply")
    monkeypatch.chdir(tmp_path)
    app(
        ["inspect", "pipe.ply", "--wall-mm", "9", "--out", "pipe.json", "--coloured", "c.ply"],
        result_action="return_value",
    )
    record = json.loads((tmp_path / "pipe.json").read_text())
    assert any("does not contain uncertainties" in note for note in record["notes"])
    pit = next(each for each in record["features"] if each["kind"] == "pit")
    assert pit["values"]["depth"]["systematic"] is None and pit["values"]["depth"]["random"] > 0
    assert pit["values"]["depth"]["source"].startswith("ASME B31G")
    assert "pit 1" in capsys.readouterr().out
    deviation = uwlts.read("c.ply").deviation_mm
    # As on the page: blue in the pit, red on protrusions, pale elsewhere.
    red, _, blue, _ = np.asarray(trimesh.load("c.ply").colors, int).T
    assert (blue > red)[deviation < -0.1].all() and (blue <= red)[deviation > 0.01].all()
    assert len(np.unique(red)) > 50
    assert np.nanmin(deviation) == pytest.approx(-0.6, abs=0.15)


def test_every_value_has_a_definition_with_a_source():
    assert set(DEFINITIONS) == set(FeatureKind)
    for values in DEFINITIONS.values():
        for definition in values.values():
            assert definition.text and definition.source and definition.unit in ("mm", "mm2", "deg", "%")


def test_the_guide_has_all_definitions():
    page = (Path(__file__).resolve().parents[3] / "docs" / "reference" / "inspection-values.md").read_text(
        encoding="utf-8"
    )
    for kind, values in DEFINITIONS.items():
        for name, definition in values.items():
            assert f"| {kind} | {name} | {definition.unit} | {definition.text} | {definition.source} |" in page


def test_wrong_input_is_refused():
    rng = np.random.default_rng(12)
    cloud = flat_scan(rng, lambda x, y: 0 * x, everywhere, along=(-5, 5, 1.0), across=(-20, 20, 100))
    for words, options in (
        ("a weld does not take `wall_mm`", {"kind": "weld", "wall_mm": 9.0}),
        ("wall_mm is -1", {"wall_mm": -1.0}),
        ("false_alarm is 2", {"false_alarm": 2.0}),
        ("no bead found", {"kind": "weld"}),
    ):
        with pytest.raises(EvaluationError, match=words):
            inspect_cloud(cloud, **({"kind": "pipe"} | options))
    few = PointCloud(cloud.points_mm[:50], cloud.intensity[:50], cloud.frame[:50], cloud.line[:50])
    for kind in ("pipe", "weld"):
        with pytest.raises(EvaluationError, match="at least"):
            inspect_cloud(few, kind)
