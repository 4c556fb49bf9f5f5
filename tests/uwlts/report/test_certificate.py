"""Certificates: seal, statements on lengths and form, and page."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import uwlts
from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import MEDIUM, joint_calibration
from uwlts.calibration.joint.calibrated_volume import (
    compare_calibrations,
    compute_volume_lengths,
    find_ends,
    length_uncertainties,
    prepare_use,
    remove_rigid_motion,
    uncertainty_maps,
)
from uwlts.calibration.joint.observability import SheetRegion, list_regions, project_sheet_points, read_region_estimate
from uwlts.errors import CalibrationError, CaptureError, OutputError
from uwlts.files.json_files import compute_seal, to_canonical_json
from uwlts.model.calibration import KnownMedium
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.report.certificate import certificate_lines, check_certificate, make_certificate, read_certificate
from uwlts.report.certificate_page import write_certificate
from uwlts.storage.calibration_file import load_calibration

BUILT = built_sensor()
ISSUED = "2026-01-02T03:04:05+00:00"
DRAWS = 300


@pytest.fixture(scope="module")
def path(thesis, tmp_path_factory):
    path = tmp_path_factory.mktemp("certificate") / "calibration.json"
    joint_calibration(thesis, columns=15).save(path)
    return path


@pytest.fixture(scope="module")
def calibration(path):
    return load_calibration(path)


@pytest.fixture(scope="module")
def use(calibration):
    return prepare_use(calibration, list_regions(calibration)[0])


@pytest.fixture(scope="module")
def content(calibration, path):
    return make_certificate(calibration, path, issued=ISSUED)


@pytest.fixture(scope="module")
def written(path, thesis):
    """The certificate's page and its content, compared with the drawings."""
    nominal_calibration(thesis).save(path.with_name("drawings.json"))
    return write_certificate(path, out=path.with_name("cert.html"), before=path.with_name("drawings.json"))


def test_the_same_calibration_gives_the_same_json(calibration, path, content):
    again = make_certificate(load_calibration(path), path, issued=ISSUED)
    stored = content.in_file()
    assert json.dumps(again.in_file()) == json.dumps(stored)
    # The seal depends neither on the order of keys nor on the stored seal.
    assert to_canonical_json(dict(reversed(stored.items()))) == to_canonical_json(stored)
    assert compute_seal(stored) == content.sha256 == stored["sha256"]


def test_a_changed_byte_is_found(path, content, written, tmp_path):
    page, issued = written
    assert issued.parameters == content.parameters
    assert check_certificate(page.with_suffix(".json"), path) == []
    text, beside = page.with_suffix(".json").read_text(encoding="utf-8"), tmp_path / "cert.json"
    place = text.index('"std": ') + 9
    digit = "1" if text[place] != "1" else "2"
    beside.write_text(text[:place] + digit + text[place + 1 :], encoding="utf-8")
    assert "was changed after it was issued" in check_certificate(beside, path)[0]
    beside.write_text(text, encoding="utf-8")
    other = tmp_path / "calibration.json"
    changed = bytearray(path.read_bytes())
    changed[-20] ^= 1
    other.write_bytes(changed)
    assert "is not the calibration" in check_certificate(beside, other)[0]


def test_a_file_that_is_no_certificate_is_refused(path, tmp_path):
    with pytest.raises(CaptureError, match="not a certificate"):
        read_certificate(path)
    newer = tmp_path / "newer.json"
    newer.write_text('{"format": "uwlts-certificate", "version": 9}', encoding="utf-8")
    with pytest.raises(CaptureError, match="version 9"):
        read_certificate(newer)


def test_the_calibration_itself_is_never_replaced(path):
    with pytest.raises(OutputError, match="is an input"):
        uwlts.report.write_certificate(path, out=path.with_suffix(".html"), overwrite=True)


def test_it_says_where_it_holds(calibration, content, thesis):
    """Stripes are on the plate of 235 mm and in the image.

    They cover the travel of 180 mm minus the part that misses the plate.
    """
    validity = content.validity[0]
    assert validity.name == "water"
    assert validity.index == calibration.media[0].index
    assert 0 < validity.index_std <= 1.01e-4
    assert 100 < np.ptp(validity.z_mm) < 190
    assert 100 < np.ptp(validity.y_mm) < 235
    depth = validity.camera_depth_mm
    assert 0.8 * np.ptp(validity.z_mm) < depth[1] - depth[0] < np.ptp(validity.z_mm)
    assert sum(image.residual_count for image in content.images) == content.residuals
    assert {image.source for image in content.images} == {f"target, frame {n}" for n in range(6)}
    assert content.made_from["target"]["kind"] == "circles"
    tilt = next(row for row in content.parameters if row.name == "window_slope_x")
    assert tilt.unit == "°"
    assert tilt.std_before == pytest.approx(thesis.uncertainty.window_tilt_deg, rel=1e-3)


def points(calibration, known, values, pixels):
    """Points (N, 3) in the OCS of the calibration by other values of its parameters."""
    changed = calibration.model_copy(
        update={
            "camera": known.parameters.camera(values),
            "window": known.parameters.window_model(values),
            "sheet": known.parameters.sheet_model(values),
        }
    )
    index = known.parameters.medium_index(values, known.view)
    return reconstruct_pixels(
        changed, pixels, medium_index=index, stage_mm=0.0, stage_direction=np.array([1.0, 0.0, 0.0])
    ).points_mm


@pytest.mark.slow
def test_uncertainties_of_lengths_agree_with_draws(calibration, use):
    """Draw parameters and reconstruct with them: the standard deviation of 300 draws has an error of 4 % (1 sigma).

    The largest of 81 positions is compared with the largest by draws, which is slightly higher.
    """
    known = use.known
    drawn = np.random.default_rng(1).multivariate_normal(known.values, use.covariance, DRAWS, method="svd")
    compared = 0
    for stated in length_uncertainties(use):
        if stated.axis == "X" or stated.length_mm not in (20.0, 100.0):
            continue
        pixels = project_sheet_points(known, find_ends(use.region, stated.axis, stated.length_mm).reshape(-1, 2))
        found = np.array([points(calibration, known, values, pixels) for values in drawn])
        lengths = np.linalg.norm(found[:, 1::2] - found[:, ::2], axis=2)
        assert stated.calibration_mm == pytest.approx(2 * np.std(lengths, axis=0).max(), rel=0.2)
        assert stated.point_mm > stated.calibration_mm
        compared += 1
    assert compared == 4


def test_the_largest_uncertainty_of_the_volume_is_stated(use):
    """No position alone has a larger uncertainty, and one has the stated one; positions differ by more than 2 %."""
    checked = 0
    for stated in length_uncertainties(use):
        if stated.axis != "X" and stated.length_mm in (20.0, 50.0):
            places = find_ends(use.region, stated.axis, stated.length_mm)
            lengths = [compute_volume_lengths(use, place[None]) for place in places]
            for noise, value in ((0.0, stated.calibration_mm), (use.noise_px, stated.point_mm)):
                alone = [2 * each.std_mm(use.covariance, noise_px=noise).item() for each in lengths]
                assert value == pytest.approx(max(alone), rel=1e-9)
                assert min(alone) < 0.98 * value
                checked += 1
    assert checked == 8


def test_the_terminal_names_the_longest_length_of_each_axis(content):
    lines = certificate_lines(content)
    for axis in "XYZ":
        longest = max((row for row in content.lengths if row.axis == axis), key=lambda row: row.length_mm)
        assert f"{1e3 * longest.calibration_mm:.1f} µm of {longest.length_mm:g} mm along {axis}" in lines[0]


def test_along_x_the_stage_counts(use, thesis):
    """Two positions and the scale of 100 mm, twice: k = 2."""
    known = thesis.uncertainty
    stated = next(w for w in length_uncertainties(use) if w.axis == "X" and w.length_mm == 100.0)
    assert stated.calibration_mm == pytest.approx(
        2 * np.sqrt(2 * known.stage_position_mm**2 + (100 * known.stage_scale) ** 2)
    )


def test_drift_of_the_water_counts(calibration):
    """In water whose index follows from its temperature; 5 K change it by 5e-4 and more."""
    water = MEDIUM.model_copy(update={"kind": "fresh", "index": None})
    medium = KnownMedium(medium=water, index=calibration.media[0].index)
    known = calibration.provenance["known_before"]
    std = []
    for kelvin in (0.0, 5.0):
        provenance = calibration.provenance | {"known_before": known | {"drift_k": kelvin}}
        warmer = calibration.model_copy(update={"media": (medium,), "provenance": provenance})
        found = length_uncertainties(prepare_use(warmer, list_regions(warmer)[0]))
        std.append(next(w.calibration_mm for w in found if w.axis == "Y" and w.length_mm == 100.0))
    assert std[1] > 2 * std[0]


def test_rigid_motions_leave_the_form():
    rng = np.random.default_rng(0)
    at = rng.uniform(-50, 50, (40, 2))
    full = np.column_stack([np.zeros(40), at])
    motion = np.cross([1e-3, -2e-3, 3e-3], full) + [0.1, 0.2, -0.3]
    bent = np.column_stack([np.zeros((40, 2)), 1e-5 * at[:, 0] ** 2])
    assert np.abs(remove_rigid_motion(at, motion[None])).max() < 1e-12
    left = remove_rigid_motion(at, (motion + bent)[None])[0]
    assert np.allclose(left, remove_rigid_motion(at, bent[None])[0])
    assert left.std() > 0.2 * bent.std()


def test_the_form_is_known_better_than_single_points(use):
    mesh, maps = uncertainty_maps(use)
    assert mesh.shape == (17, 21, 2) and all(values.shape == (17, 21) for values in maps.values())
    for axis in "XYZ":
        assert (maps[f"u({axis}), single point"] >= maps[f"u({axis}), calibration"]).all()
    assert 0 < max(maps[f"u({axis}), calibration"].max() for axis in "YZ") < 0.05
    # 0.1 px of noise: some 15 µm across the line, which is far more than the calibration leaves open.
    assert np.median(maps["u(Z), single point"]) > 2 * np.median(maps["u(Z), calibration"])
    assert {f"u of {length} mm along Y" in maps for length in (20, 50)} == {True, False}


def test_lengths_shown_where_they_are_measured_stay_in_the_volume(use):
    region = use.region
    mesh = region.mesh(5, 7)
    low, high = region.outline_mm.min(axis=0), region.outline_mm.max(axis=0)
    assert ((mesh >= low - 1e-9) & (mesh <= high + 1e-9)).all()
    corner = SheetRegion("water", MEDIUM, region.view, np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]), np.zeros(2), 3)
    assert corner.width_at(5.0) == pytest.approx((0.0, 5.0))
    assert corner.has_area()
    assert not replace(corner, outline_mm=corner.outline_mm[:2]).has_area()


def test_against_another_calibration(calibration, thesis):
    """Half a per cent of the focal length changes all distances across the axis by as much, and none to itself."""
    region = list_regions(calibration)[0]
    same = compare_calibrations(calibration, calibration, region)
    assert same.largest_mm < 1e-9
    camera = calibration.camera.model_copy(
        update={"fx_px": 1.005 * calibration.camera.fx_px, "fy_px": 1.005 * calibration.camera.fy_px}
    )
    change = compare_calibrations(calibration, calibration.model_copy(update={"camera": camera}), region)
    width = change.moved_mm[8, -1, 1] - change.moved_mm[8, 0, 1]
    assert width == pytest.approx(0.005 * (change.at_mm[8, -1, 0] - change.at_mm[8, 0, 0]), rel=0.4)
    small = calibration.camera.model_copy(update={"width_px": 640})
    with pytest.raises(CalibrationError, match="image size is 1280 x 1024 px in one and 640 x 1024"):
        compare_calibrations(calibration, calibration.model_copy(update={"camera": small}), region)


def test_the_certificate_is_complete_and_loads_nothing_from_the_network(written):
    path, content = written
    page = path.read_text(encoding="utf-8")
    for words in (
        "Uncertainty of lengths",
        "Weakly determined parameters",
        "Correlation of the parameters",
        "Comparison with drawings",
        content.sha256,
        content.calibration.sha256,
        "turn of the laser&#39;s window",
    ):
        assert words in page, words
    assert "://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert "<script" not in page
    assert page.count("<svg") == 3 + 8 + 3
    # Maps contain encoded pixels with arbitrary letters.
    text = re.sub(r'base64,[^"]*', "", page).lower()
    assert len(text) > 10_000 and "nan" not in text.replace("nanometre", "")


def test_only_a_joint_calibration_gets_a_certificate(thesis, tmp_path):
    path = tmp_path / "nominal.json"
    nominal_calibration(thesis).save(path)
    with pytest.raises(CalibrationError, match="calibrate jointly"):
        write_certificate(path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_damaged_volume_is_reported(calibration):
    damaged = calibration.joint.model_copy(
        update={"covered": (calibration.joint.covered[0].model_copy(update={"medium": 7}),)}
    )
    with pytest.raises(CalibrationError, match="covered volume is damaged"):
        list_regions(calibration.model_copy(update={"joint": damaged}))
    region = list_regions(calibration)[0]
    assert read_region_estimate(calibration, region).view == region.view
