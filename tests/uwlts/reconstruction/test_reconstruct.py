"""Reconstruction of the same stripes with any calibration; media allowed for each calibration."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor, stage_images, stripes_on_target
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.calibration.sequential.sequential_calibration import (
    CalibrationOptions,
    Evidence,
    calibrate_sequentially,
    gather,
    solve,
)
from uwlts.errors import CalibrationError, CaptureError, RangeError
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Medium
from uwlts.optics.fitness import check_fits
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_profile
from uwlts.reconstruction.reconstruct import reconstruct, reconstruct_stripes
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import NO_STAGE, Capture, CaptureHeader, Frame, FrameTable, describe_source
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.stripe import StripeOptions, find_stripes
from uwlts.targets import ChessboardTarget

WIDTH, HEIGHT = 160, 120
AIR, FRESH, SEA = Medium(kind="air"), Medium(kind="fresh"), Medium(kind="sea", salinity_g_kg=35.0)
SLOPE = 0.05


def small_sensor(*, mounted=True, **camera):
    sensor = load_sensor("thesis")
    window = sensor.camera.window.model_copy(update={"mounted": mounted})
    size = {"width_px": WIDTH, "height_px": HEIGHT, "principal_point_px": None, "window": window}
    return sensor.model_copy(update={"camera": sensor.camera.model_copy(update=size | camera)})


def row(number):
    """Rows of the stripe in an image, by column."""
    return 50.3 + SLOPE * np.arange(WIDTH) + number


def stripe_image(number):
    away = np.arange(HEIGHT)[:, None] - row(number)
    return np.round(200 * np.exp(-0.5 * (away / 1.2) ** 2)).astype(np.uint8)


def write(
    path,
    *,
    medium=FRESH,
    sensor=None,
    lasers=(False, True, True, False, True),
    blank=False,
    target=None,
    shown=None,
    **more,
):
    """A capture of stripes; images with the laser off show one, too, which is not to be found."""
    header = CaptureHeader(
        name="scan",
        sensor=sensor or small_sensor(),
        medium_name=f"the {medium.kind}",
        medium=medium,
        stage_direction=(1, 0, 0),
        saturation_dn=255,
        target=target,
        **more,
    )
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number, laser in enumerate(lasers):
            image = (
                np.zeros((HEIGHT, WIDTH), np.uint8)
                if blank
                else stripe_image(number if shown is None else shown[number])
            )
            writer.append(Frame(image, stage_mm=2.0 * number, laser_on=laser, exposure_ms=1.0, time_s=float(number)))
    return path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write(tmp_path_factory.mktemp("scan") / "scan.h5")


CALIBRATION = nominal_calibration(small_sensor())


def test_stripes_are_those_of_the_laser_images(path):
    reported = []
    with Capture(path) as capture:
        stripes = find_stripes(capture, progress=lambda done, total: reported.append((done, total)))
    assert reported == [(2, 5), (3, 5), (5, 5)]
    assert sorted(set(stripes.frame.tolist())) == [1, 2, 4]
    assert len(stripes.frame) == len(stripes.line) == len(stripes.centre_px) == len(stripes.amplitude)
    assert len(stripes.line) > 3 * (WIDTH - 20)
    # A Gaussian of 1.2 px, sampled: 0.01 px.
    expected = 50.3 + SLOPE * stripes.line + stripes.frame
    np.testing.assert_allclose(stripes.centre_px, expected, atol=0.01)
    np.testing.assert_allclose(stripes.amplitude, 200, rtol=0.05)
    assert sum(stripes.lines_by_status.values()) == 3 * WIDTH
    assert stripes.lines_by_status["ok"] == len(stripes.line)


def test_stripes_do_not_depend_on_the_number_of_threads(path, monkeypatch):
    found = []
    for processors in (1, 4):
        monkeypatch.setattr("uwlts.runtime.workers.count_processors", lambda count=processors: count)
        with Capture(path) as capture:
            found.append(find_stripes(capture))
    alone, together = found
    assert len(alone.line) > 3 * (WIDTH - 20) and alone.lines_by_status == together.lines_by_status
    for name in ("frame", "line", "centre_px", "amplitude", "width_px"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(together, name), strict=True)


def test_options_reach_the_extraction(path):
    with Capture(path) as capture:
        assert len(find_stripes(capture).line) > 400
        with pytest.raises(CaptureError, match="no stripe in any of the 3 laser images"):
            find_stripes(capture, options=StripeOptions(threshold_floor=250.0))


@pytest.mark.parametrize(
    ("how", "message"),
    [({"lasers": (False, False)}, "none of them with the laser on"), ({"blank": True}, "all are black")],
)
def test_captures_without_stripes_are_refused(tmp_path, how, message):
    with Capture(write(tmp_path / "none.h5", **how)) as capture, pytest.raises(CaptureError, match=message):
        find_stripes(capture)


def test_both_halves_make_the_whole(path):
    with Capture(path) as capture:
        whole = reconstruct(capture, CALIBRATION)
        stripes = find_stripes(capture)
        halves = reconstruct_stripes(capture, stripes, CALIBRATION)
    np.testing.assert_array_equal(halves.points_mm, whole.points_mm)
    np.testing.assert_array_equal(halves.frame, stripes.frame)
    np.testing.assert_array_equal(halves.line, stripes.line)
    np.testing.assert_array_equal(halves.intensity, whole.intensity)
    assert halves.metadata == whole.metadata
    assert halves.lines_by_status == whole.lines_by_status == stripes.lines_by_status
    assert halves.rays_by_status == whole.rays_by_status


def test_given_centres_are_reconstructed(path):
    with Capture(path) as capture:
        stripes = find_stripes(capture)
        moved = replace(stripes, centre_px=stripes.centre_px + 1.5)
        scan = reconstruct_stripes(capture, moved, CALIBRATION)
        index = FRESH.refractive_index(CALIBRATION.wavelength_nm)
        expected = reconstruct_profile(
            CALIBRATION,
            moved.line,
            moved.centre_px,
            medium_index=index,
            stage_mm=2.0 * moved.frame,
            stage_direction=np.array([1.0, 0.0, 0.0]),
        )
        np.testing.assert_allclose(scan.points_mm, expected.points_mm, atol=1e-12)
        other = reconstruct_stripes(capture, moved, CALIBRATION, index=1.36)
        assert np.abs(other.points_mm - scan.points_mm).max() > 0.1
        assert (scan.metadata["medium_index"], other.metadata["medium_index"]) == (index, 1.36)
        with pytest.raises(RangeError, match="refractive index"):
            reconstruct_stripes(capture, moved, CALIBRATION, index=0.9)


def single_viewpoint(medium):
    return CALIBRATION.model_copy(update={"window": None, "medium_kind": medium.kind})


@pytest.mark.parametrize(
    ("calibration", "medium", "refusal"),
    [
        (single_viewpoint(FRESH), FRESH, None),
        (single_viewpoint(FRESH), AIR, "made in air, but the calibration has a single viewpoint in water"),
        (single_viewpoint(FRESH), SEA, "the calibration is for fresh only"),
        (single_viewpoint(SEA), SEA, None),
        (single_viewpoint(AIR), AIR, None),
        (single_viewpoint(AIR), FRESH, r"the calibration is for air only: .*`step`"),
        (CALIBRATION, AIR, None),
        (CALIBRATION, FRESH, None),
        (CALIBRATION, SEA, None),
        # With a window it holds in all media, whichever it is a nominal one of.
        (nominal_calibration(small_sensor(), FRESH), AIR, None),
        (nominal_calibration(small_sensor(), FRESH), SEA, None),
    ],
)
def test_a_calibration_without_a_window_holds_in_its_own_medium(tmp_path, calibration, medium, refusal):
    with Capture(write(tmp_path / "scan.h5", medium=medium)) as capture:
        if refusal is None:
            check_fits(capture.header, calibration, source=capture.path.name)
            scan = reconstruct_stripes(capture, find_stripes(capture), calibration)
            assert len(scan) == scan.rays_by_status["ok"] > 400
            return

        def fits(c, k):
            check_fits(c.header, k, source=c.path.name)

        for use in (fits, reconstruct, lambda c, k: reconstruct_stripes(c, find_stripes(c), k)):
            with pytest.raises(CalibrationError, match=refusal):
                use(capture, calibration)


def test_a_single_viewpoint_measures_along_straight_rays(tmp_path):
    """Refraction is in its camera: the medium's index does not matter."""
    with Capture(write(tmp_path / "scan.h5")) as capture:
        stripes = find_stripes(capture)
        scan = reconstruct_stripes(capture, stripes, single_viewpoint(FRESH))
        other = reconstruct_stripes(capture, stripes, single_viewpoint(FRESH), index=1.4)
    np.testing.assert_array_equal(scan.points_mm, other.points_mm)


def test_the_window_taken_off_is_left_out(tmp_path):
    with Capture(write(tmp_path / "bare.h5", medium=AIR, sensor=small_sensor(mounted=False))) as capture:
        stripes = find_stripes(capture)
        bare = reconstruct_stripes(capture, stripes, CALIBRATION).points_mm
        straight = reconstruct_stripes(capture, stripes, single_viewpoint(AIR)).points_mm
    np.testing.assert_array_equal(bare, straight)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"width_px": 158}, "images of 160 x 120 pixels, the calibration is for 158 x 120"),
        ({}, "the stripe runs along"),
    ],
)
def test_another_camera_is_refused(path, camera, message):
    other = CALIBRATION.model_copy(update={"camera": CALIBRATION.camera.model_copy(update=camera)})
    other = other if camera else other.model_copy(update={"stripe_along": "height"})
    with Capture(path) as capture, pytest.raises(CalibrationError, match=message):
        check_fits(capture.header, other, source=path.name)


def test_another_black_level_than_that_of_the_calibration_is_reported(tmp_path):
    def fits(here, there):
        with Capture(write(tmp_path / f"{here}.h5", provenance={"black_level": here})) as capture:
            assert describe_source(capture).in_file().get("black_level") == here
            source = {"file": "a.h5", "sha256": "0", "black_level": there}
            known = CALIBRATION.model_copy(update={"provenance": {"air_captures": [source]}})
            return check_fits(capture.header, known, source="scan")

    assert fits(None, 4.0) == fits(4.0, 4.0) == fits(5.0, None) == []
    assert fits(64.0, 4.0) == ["scan has the camera's black level 64, its calibration 4: set it as before"]


def test_images_from_another_place_of_the_image_sensor_are_refused(path, tmp_path):
    """Cropped images of the same size have another principal point."""
    cropped = small_sensor()
    cropped = cropped.model_copy(update={"camera": cropped.camera.model_copy(update={"offset_px": (64, 8)})})
    with Capture(write(tmp_path / "a.h5", sensor=cropped)) as capture:
        assert describe_source(capture).in_file()["offset_px"] == [64, 8]

    def fits(offset, *stated):
        camera = small_sensor().camera.model_copy(update={"offset_px": offset})
        with Capture(path) as capture:
            sensor = capture.header.sensor.model_copy(update={"camera": camera})
            header = capture.header.model_copy(update={"sensor": sensor})
        sources = [{"file": "a.h5", "sha256": "0"} | ({"offset_px": each} if each else {}) for each in stated]
        known = CALIBRATION.model_copy(update={"provenance": {"air_captures": sources}})
        return check_fits(header, known, source="scan")

    assert fits(None, None) == fits((64, 8), [64, 8], None) == fits((0, 0), [0, 0]) == []
    with pytest.raises(
        CalibrationError, match=r"from \(64, 8\) px of the image sensor, .* for images from \(0, 8\) px"
    ):
        fits((64, 8), [0, 8])
    with pytest.raises(CalibrationError, match=r"from \(0, 0\) px"):
        fits((0, 0), [0, 0], [0, 8])
    assert ["only one of scan" in each for each in fits((0, 0), None) + fits(None, [4, 4])] == [True, True]


def test_another_sensor_s_calibration_is_noticed(path):
    other, camera = CALIBRATION.model_copy(update={"sensor_name": "other"}), CALIBRATION.camera
    assert reconstruct(path, CALIBRATION).warnings == []
    (warning,) = reconstruct(path, other).warnings
    assert "the calibration of 'other': check that it is the right one" in warning
    long = camera.model_copy(update={"fx_px": 2 * camera.fx_px, "fy_px": 2 * camera.fy_px})
    with pytest.raises(CalibrationError, match=r"described focal length is \d+ px, the calibrated one is \d+ px"):
        reconstruct(path, other.model_copy(update={"camera": long}))
    with pytest.raises(CalibrationError, match="taken with a laser of 635 nm, the calibration is for 520 nm"):
        reconstruct(path, CALIBRATION.model_copy(update={"wavelength_nm": 520.0}))


def test_the_medium_of_the_targets_images_is_kept(tmp_path):
    sensor = built_sensor()
    images, poses, _ = stage_images(sensor, positions=np.arange(4) * 50.0)
    board = ChessboardTarget(columns=200, rows=200, square_mm=9.0)
    evidence = Evidence(
        sensor=sensor,
        medium_kind="fresh",
        stage_direction=np.array([0.0, 0.0, 1.0]),
        approaching=True,
        air=AirEvidence(
            board,
            images,
            [(0, n) for n in range(4)],
            stripes_on_target(sensor, poses, count=200),
            [],
            captures=["air.h5"],
        ),
        window=None,
        steps=[],
        sources={},
        warnings=[],
    )
    for medium_kind in ("fresh", "air"):
        solved = solve(replace(evidence, medium_kind=medium_kind), options=CalibrationOptions()).calibration
        assert (solved.medium_kind, solved.window) == (medium_kind, None)
        solved.save(tmp_path / f"{medium_kind}.json")
        assert load_calibration(tmp_path / f"{medium_kind}.json").medium_kind == medium_kind


def test_images_of_the_target_come_from_one_medium(tmp_path):
    target = {
        "kind": "circles",
        "diameter_mm": 6.0,
        "marker_diameter_mm": 2.5,
        "columns": 17,
        "rows": 17,
        "origin": (8, 8),
    }
    files = {
        medium.kind: write(tmp_path / f"{medium.kind}.h5", medium=medium, target=target, lasers=(False,))
        for medium in (AIR, FRESH)
    }
    with Capture(files["air"]) as air, Capture(files["fresh"]) as fresh:
        with pytest.raises(CalibrationError, match="seen in air and fresh"):
            gather([air, fresh], [], options=CalibrationOptions())
        # With a step standard in water the target must have been seen in air.
        with pytest.raises(CalibrationError, match="seen in fresh: take all images of it in air"):
            calibrate_sequentially([fresh], [fresh])
        # All in water is the single viewpoint: refused here only because these images show no target.
        with pytest.raises(CalibrationError, match="found in no image"):
            calibrate_sequentially([fresh])


def test_rows_of_a_rolling_shutter_are_where_the_stage_was_when_they_were_exposed(path):
    speed, line_time_us = 40.0, 50.0
    with Capture(path) as capture:
        stripes = find_stripes(capture)
        frames = list(capture)
        header = capture.header
    detector = header.sensor.detector.model_copy(update={"shutter": "rolling", "line_time_us": line_time_us})
    rolling = header.model_copy(update={"sensor": header.sensor.model_copy(update={"detector": detector})})
    at_rest = reconstruct_stripes(FrameTable.from_frames(header, frames), stripes, CALIBRATION)
    moving = [replace(frame, speed_mm_per_s=speed) for frame in frames]
    together = reconstruct_stripes(FrameTable.from_frames(header, moving), stripes, CALIBRATION)
    rows = reconstruct_stripes(FrameTable.from_frames(rolling, moving), stripes, CALIBRATION)
    np.testing.assert_array_equal(together.points_mm, at_rest.points_mm)
    # The stripe's rows are 1e-6 line_time later than the middle row for each row below it; the stage moves along X.
    np.testing.assert_array_equal(rows.line, stripes.line)
    delay_s = 1e-6 * line_time_us * (stripes.centre_px - (HEIGHT - 1) / 2)
    np.testing.assert_allclose((rows.points_mm - at_rest.points_mm)[:, 0], speed * delay_s, atol=1e-9)
    np.testing.assert_allclose((rows.points_mm - at_rest.points_mm)[:, 1:], 0, atol=1e-9)
    assert np.ptp(speed * delay_s) > 0.01


def test_free_poses_are_refused(tmp_path):
    free = {"provenance": {"stage": NO_STAGE}}
    path = write(tmp_path / "free.h5", **free)
    with pytest.raises(
        CalibrationError, match="3 laser images of free.h5 have free poses, which are unknown: .* or give a"
    ):
        reconstruct(path, CALIBRATION)
    # The points of a single image need no position.
    assert len(reconstruct(write(tmp_path / "one.h5", lasers=(True,), **free), CALIBRATION)) == WIDTH


def test_a_repeated_image_is_reported(tmp_path, path):
    assert reconstruct(path, CALIBRATION).warnings == []
    twice = reconstruct(write(tmp_path / "twice.h5", lasers=4 * (True,), shown=(0, 1, 1, 2)), CALIBRATION)
    (warning,) = twice.warnings
    assert "the stripe in 1 of 4 images is exactly that in the image before, such as in image 2" in warning


RISING = tuple(range(21))


@pytest.mark.parametrize(
    ("shown", "strange"),
    [
        (RISING, None),
        (
            (*RISING[:9], 10, 9, *RISING[11:]),
            "2 of 21 images is not between those of its neighbours, such as in image 9:",
        ),
        ((*RISING[:9], 40, *RISING[10:]), "1 of 21 images is not between those of its neighbours, such as in image 9:"),
        (tuple(40 if n % 5 == 2 else n for n in RISING), "4 of 21 images is not between"),  # a fifth of another scan
        ((*RISING[:9], *range(30, 42)), None),  # the edge of a step
        ((*RISING[:12], *reversed(RISING[2:11])), None),  # a ridge
        ((0, 3, 1, 5, 2, 4, 1) * 3, None),  # a surface that is rough from image to image
    ],
)
def test_images_that_do_not_fit_between_their_neighbours_are_reported(tmp_path, shown, strange):
    found = reconstruct(write(tmp_path / "scan.h5", lasers=len(shown) * (True,), shown=shown), CALIBRATION).warnings
    assert len(found) == (strange is not None)
    assert strange is None or strange in found[0]


def test_the_index_of_other_water_is_reported_in_the_cloud(path):
    own = CALIBRATION.medium_index(FRESH)
    assert reconstruct(path, CALIBRATION, index=own + 0.0009).warnings == []
    assert f"not that of the medium, {own:.5g}" in reconstruct(path, CALIBRATION, index=own + 0.0011).warnings[0]
