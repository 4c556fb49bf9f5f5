"""Guided calibration: images are assessed correctly, and the requested poses lead to a good camera quickly."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.uwlts.calibration_views import STEP_MM, WATER, inside, lens_of, step_profile, through_window
from tests.uwlts.drawn_target import drawn_lamp, drawn_laser, target_pose
from uwlts.calibration.camera.image_quality import (
    edge_blur_px,
    explain_missing_target,
    judge_motion,
    judge_novelty,
    judge_stripe,
    judge_target,
    measure_shift_px,
)
from uwlts.calibration.guidance import (
    CompletionLimits,
    RecordedPose,
    Setting,
    State,
    best_pose,
    candidates,
    compute_gain,
    compute_shortfall,
    coverage_of,
    describe_missing,
    describe_missing_sheet,
    estimate_pose,
    format_pose_advice,
    is_separate_depth,
    judge_residual,
    judge_step,
    next_depth_mm,
    nominal_camera,
    place_words,
    select_separate_depths,
    solve_state,
    tilts_rad,
)
from uwlts.errors import TargetError
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import WindowModel
from uwlts.model.library import merge_tables
from uwlts.model.parameter_keys import LensParameter
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.targets import ChessboardTarget, CircleTarget, TargetView

FULL = 255
SMALL = {
    "name": "small",
    "camera": {"width_px": 640, "height_px": 512, "pixel_size_um": 10.6, "principal_point_px": (322.8, 252.7)},
}
PLATE = CircleTarget(
    spacing_x_mm=12.0,
    spacing_y_mm=12.0,
    diameter_mm=7.0,
    marker_diameter_mm=3.0,
    columns=11,
    rows=9,
    origin=(5, 4),
    marker_x=(1, 0),
    marker_y=(0, 1),
)
BOARD = ChessboardTarget(columns=11, rows=8, square_mm=12.0)
NOISE_PX = 0.05
NO_STRIPE = np.empty((0, 2))
LIMITS = CompletionLimits()


@pytest.fixture(scope="module")
def small(thesis_as_built: Sensor) -> Sensor:
    return Sensor.model_validate(merge_tables(thesis_as_built.model_dump(), SMALL))


@pytest.fixture(scope="module")
def setting(thesis_as_built: Sensor) -> Setting:
    return Setting(thesis_as_built, BOARD, thesis_as_built.medium("air"), "free")


def seen(setting: Setting, pose: np.ndarray, rng: np.random.Generator) -> TargetView:
    """Detect a target at a pose with the camera as built."""
    points = setting.target.points_mm
    columns, rows = np.meshgrid(np.arange(setting.target.columns), np.arange(setting.target.rows))
    pixels = lens_of(setting.sensor).pixels(points @ pose[:3, :3].T + pose[:3, 3])
    here = inside(pixels, setting.sensor)
    indices = np.column_stack([columns.ravel(), rows.ravel()])
    return TargetView(pixels[here] + rng.normal(0, NOISE_PX, (here.sum(), 2)), points[here], indices[here], {})


def state_of(setting: Setting, poses, rng: np.random.Generator, wanted: CompletionLimits = LIMITS) -> State:
    recorded = [RecordedPose(seen(setting, pose, rng), NO_STRIPE, float(k)) for k, pose in enumerate(poses)]
    return solve_state(recorded, setting, wanted)


# Judging images


def judged(small: Sensor, image: np.ndarray):
    return judge_target(image, PLATE.detect(image), PLATE, full_dn=FULL)


def test_a_good_image_is_accepted(small):
    quality = judged(small, drawn_lamp(small, PLATE, target_pose()))
    assert quality.reasons == () and quality.points == 99
    # Drawn with a blur of 0.6 px and pixels that average over themselves, 0.29 px; read from pixels' differences.
    assert 0.5 < quality.blur_px < 1.2


def test_blur_is_measured_and_refused(small):
    blurs = [judged(small, drawn_lamp(small, PLATE, target_pose(), blur_px=b)) for b in (0.6, 1.5, 3.5)]
    assert blurs[0].blur_px < blurs[1].blur_px < blurs[2].blur_px
    assert blurs[1].reasons == ()
    assert any(reason.startswith("blurred: edges are") for reason in blurs[2].reasons)


def test_saturation_and_faintness_are_refused(small):
    bright = judged(small, drawn_lamp(small, PLATE, target_pose(), gain=1.6))
    (reason,) = [reason for reason in bright.reasons if reason.startswith("saturated")]
    assert int(reason.split()[1]) > 10
    faint = judged(small, drawn_lamp(small, PLATE, target_pose(), gain=0.12, noise_dn=0.3))
    assert [reason[:5] for reason in faint.reasons] == ["faint"]
    # Bright and dark differ by 140 of 255 grey levels, times the gain.
    assert int(faint.reasons[0].split()[1]) == pytest.approx(0.12 * 140 / 2.55, abs=1)


@pytest.mark.parametrize(("gain", "says"), [(0.01, "too dark"), (6.0, "saturated")])
def test_light_explains_why_no_target_is_found(small, gain, says):
    image = drawn_lamp(small, PLATE, target_pose(), gain=gain)
    with pytest.raises(TargetError) as error:
        PLATE.detect(image)
    assert explain_missing_target(image, str(error.value), full_dn=FULL).startswith(says)


def test_a_target_that_is_not_there_is_reported_by_its_search(small):
    image = np.full((512, 640), 90, np.uint8)
    assert explain_missing_target(image, "found no circles", full_dn=FULL) == "found no circles"


def test_a_partial_target_is_refused(small):
    target = PLATE.model_copy(update={"columns": 31, "rows": 29, "origin": (15, 14)})
    image = drawn_lamp(small, PLATE, target_pose(middle_mm=(0.0, 0.0, 300.0)))
    image[:, :230] = image[:, 410:] = image[:190] = image[330:] = 60
    quality = judge_target(image, target.detect(image), target, full_dn=FULL)
    assert any(reason.startswith("partial") for reason in quality.reasons), quality


def test_motion_and_sameness_are_reported_in_pixels(small):
    first = PLATE.detect(drawn_lamp(small, PLATE, target_pose()))
    again = PLATE.detect(drawn_lamp(small, PLATE, target_pose(), seed=1))
    # f of about 1220 px at 378 mm: 1 mm is 3.2 px.
    shifted = PLATE.detect(drawn_lamp(small, PLATE, target_pose(middle_mm=(1.0, 0.0, 378.0))))
    assert measure_shift_px(first, again) < 0.1 and judge_motion(first, again) == ()
    assert measure_shift_px(first, shifted) == pytest.approx(lens_of(small).fx / 378, rel=0.03)
    assert judge_motion(first, shifted)[0].startswith("moved: the target moved 3.")
    assert judge_novelty(again, [shifted, first])[0].startswith("too similar to image 2: differs by 0.")
    moved = PLATE.detect(drawn_lamp(small, PLATE, target_pose(tilt_deg=(20, 0))))
    assert judge_novelty(moved, [first, shifted]) == ()
    none_in_common = replace(first, indices=first.indices + 100)
    assert measure_shift_px(first, none_in_common) == np.inf and judge_motion(first, none_in_common)


def test_the_stripe_counts_where_it_lies_on_the_target(small):
    pose = target_pose(middle_mm=(0.0, 0.0, 378.0))
    view = PLATE.detect(drawn_lamp(small, PLATE, pose))

    def stripe(image):
        return judge_stripe(image, view, PLATE, stripe_along="width", full_dn=FULL)

    whole = stripe(drawn_laser(small, pose))
    # The points are 120 mm wide, and a spacing of 12 mm is allowed for beyond them.
    expected = (120 + 24) * lens_of(small).fx / 378
    assert whole.reasons == () and whole.lines == pytest.approx(expected, rel=0.05)
    away = stripe(np.roll(drawn_laser(small, pose), 230, axis=0))
    assert away.lines == 0 and away.reasons == ()
    bright = stripe(drawn_laser(small, pose, gain=4.0))
    assert bright.reasons and bright.reasons[0].startswith("stripe saturated")
    assert stripe(drawn_laser(small, pose, gain=0.0)).lines == 0


# Coverage and spread


def test_coverage_counts_cells_with_points():
    grid = coverage_of([], width_px=1280, height_px=1024)
    assert grid.counts.shape == (6, 8) and grid.share == 0.0
    points = np.array([[10.0, 10.0]] * 3 + [[1270.0, 1015.0]] * 2 + [[5000.0, 1.0]])
    covered = coverage_of([points], width_px=1280, height_px=1024)
    assert covered.covered[0, 0] and not covered.covered[-1, -1] and covered.counts.sum() == 5
    assert covered.share == pytest.approx(1 / 48)
    everywhere = np.stack(np.meshgrid(np.arange(0, 1280, 20.0), np.arange(0, 1024, 20.0)), 2).reshape(-1, 2)
    left = everywhere[everywhere[:, 0] < 850]
    assert coverage_of([left], width_px=1280, height_px=1024).emptiest().endswith("right")
    assert coverage_of([everywhere], width_px=1280, height_px=1024).emptiest() is None
    assert [place_words(x, y) for x, y in ((0.1, 0.9), (0.5, 0.1), (0.5, 0.5), (0.9, 0.5))] == [
        "lower left",
        "top",
        "middle",
        "right",
    ]


def test_tilts_are_those_of_the_poses():
    poses = [target_pose(tilt_deg=(20, 0)), target_pose(tilt_deg=(0, -15), middle_mm=(0, 0, 420.0))]
    np.testing.assert_allclose(np.degrees(tilts_rad(poses[0])), (20, 0), atol=1e-9)
    np.testing.assert_allclose(np.degrees(tilts_rad(poses[1])), (0, -15), atol=1e-9)
    # The instructions name the farther sides: the target's right end, and its upper end.
    assert (poses[0] @ [50, 0, 0, 1])[2] > (poses[0] @ [-50, 0, 0, 1])[2]
    assert (poses[1] @ [0, -50, 0, 1])[2] > (poses[1] @ [0, 50, 0, 1])[2]


# Guidance


def led(setting: Setting, wanted: CompletionLimits, rng: np.random.Generator, *, most: int) -> State:
    """Follow the requests like a hand, with errors of about 3 deg and 5 mm."""
    poses: list[np.ndarray] = []
    state = solve_state([], setting, wanted)
    while describe_missing(state) and len(poses) < most:
        wish = best_pose(state)
        # The advised pose itself needs no further instruction.
        assert format_pose_advice(wish.candidate.pose, state, wish.candidate.pose) == "hold it still, just like this"
        pose = wish.candidate.pose.copy()
        pose[:3, :3] = cv2.Rodrigues(rng.normal(0, 0.05, 3))[0] @ pose[:3, :3]
        pose[:3, 3] += rng.normal(0, 5.0, 3)
        poses.append(pose)
        state = state_of(setting, poses, np.random.default_rng(7), wanted)
    return state


def test_following_the_advice_leads_to_a_good_camera_soon(setting, thesis_as_built):
    wanted = CompletionLimits(focal_std_px=0.5, centre_std_px=0.4, coverage=0.85, fewest_images=5)
    state = led(setting, wanted, np.random.default_rng(3), most=14)
    assert describe_missing(state) == []
    assert 5 <= len(state.recorded) <= 9
    true, std = lens_of(thesis_as_built), state.solution.std()
    assert std["f"] <= 0.5 and std["cx"] <= 0.4 and state.coverage.share >= 0.85
    # Four standard deviations: wrong by chance in one of 10,000 cases.
    assert abs(state.camera.fx_px - true.fx) < 4 * std["f"]
    assert abs(state.camera.cx_px - true.cx) < 4 * std["cx"] and abs(state.camera.cy_px - true.cy) < 4 * std["cy"]
    assert state.solution.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
    tilts = np.degrees([tilts_rad(pose) for pose in state.poses])
    assert (tilts.max(axis=0) > 12).all() and (tilts.min(axis=0) < -12).all()


def test_more_coverage_than_wanted_does_not_replace_other_evidence(setting):
    """The part of the wanted coverage that is missing counts four, what is beyond it a twentieth of that."""
    state = solve_state([], setting, CompletionLimits(coverage=0.5))
    shape = state.coverage.counts.shape

    def shortfall(share: float) -> float:
        counts = np.zeros(shape, dtype=int)
        counts.flat[: round(share * counts.size)] = 9
        return compute_shortfall(replace(state, coverage=replace(state.coverage, counts=counts)))

    size = np.prod(shape)
    few, half, most = (round(share * size) / size for share in (0.2, 0.5, 0.9))
    assert shortfall(few) - shortfall(half) == pytest.approx(4 * (1 + 0.05) * (half - few), abs=4 / size)
    assert shortfall(half) - shortfall(most) == pytest.approx(4 * 0.05 * (most - half), abs=1e-9)


@pytest.fixture(scope="module")
def advised(setting) -> State:
    """Return the state after six advised poses."""
    return led(setting, LIMITS, np.random.default_rng(3), most=6)


UNREACHED = CompletionLimits(focal_std_px=1e-6, centre_std_px=1e-6)


@pytest.fixture(scope="module")
def wished(setting) -> State:
    """Return the state after six poses, advised for limits that are never reached."""
    return led(setting, UNREACHED, np.random.default_rng(3), most=6)


def test_advised_poses_beat_as_many_random_ones(setting, wished):
    count = len(wished.poses)
    options = [*candidates(solve_state([], setting, LIMITS))]
    assert len(options) > 20
    stds = []
    for draw in range(8):
        rng = np.random.default_rng(draw)
        chosen = [options[k].pose for k in rng.choice(len(options), count, replace=False)]
        stds.append(state_of(setting, chosen, rng, UNREACHED).std()[LensParameter.F])
    # Better than the typical draw, and than nearly every one.
    assert wished.std()[LensParameter.F] < 0.8 * np.median(stds)
    assert np.mean(np.array(stds) > wished.std()[LensParameter.F]) >= 7 / 8


def test_what_is_expected_of_an_image_comes_true(wished):
    """The standard deviations expected from the information are those of the solution; the description adds little."""
    expected = wished.expected_std()
    for key, std in wished.std().items():
        # The solution's scatter has some 1000 degrees of freedom, the start of the lens matters at the percent level.
        assert expected[key] == pytest.approx(std, rel=0.1), key


def test_an_image_seen_again_gains_little(setting):
    state = led(setting, LIMITS, np.random.default_rng(3), most=1)
    wish = best_pose(state)
    again = seen(setting, state.poses[-1], np.random.default_rng(1))
    other = seen(setting, wish.candidate.pose, np.random.default_rng(1))
    assert compute_gain(state, other, wish.candidate.pose) == pytest.approx(wish.gain, rel=0.2)
    # The same points seen twice reduce the scatter by the square root of two; new points add other information.
    assert compute_gain(state, again, state.poses[-1]) < 0.4 * wish.gain


def test_poses_that_are_skipped_give_way_to_the_next_best(setting):
    state = led(setting, LIMITS, np.random.default_rng(3), most=1)
    count = len([*candidates(state)])
    first, second, last, again = (best_pose(state, skipped=skipped) for skipped in (0, 1, count - 1, count))
    assert first.gain >= second.gain >= last.gain and first.gain > last.gain
    assert len({wish.candidate.pose.tobytes() for wish in (first, second, last)}) == 3
    # After all requests were skipped, they start again.
    np.testing.assert_array_equal(again.candidate.pose, first.candidate.pose)


def test_pose_advice_is_in_plain_words(setting):
    near = target_pose(middle_mm=(-60, -40, 330.0))
    state = state_of(setting, [near], np.random.default_rng(0))
    far = target_pose(tilt_deg=(25, 0))
    far[:3, 3] = np.array([60.0, 50.0, 450.0]) - far[:3, :3] @ BOARD.points_mm.mean(axis=0)
    words = format_pose_advice(far, state, near)
    assert "right side is farther, 25 deg (now it is tilted by 0 deg)" in words
    assert "bring its middle to the lower right of the image" in words
    assert "farther, to about 450 mm from the camera (now 330 mm)" in words
    for tilt, side in (((-25, 0), "left side"), ((0, 25), "lower side"), ((18, -18), "upper right corner")):
        tilted = target_pose(tilt_deg=tilt, middle_mm=(60.0, 50.0, 450.0))
        assert f"tilt the target so that its {side} is farther" in format_pose_advice(tilted, state, None)


def test_what_is_missing_is_said(setting):
    assert any("0 images, at least 8" in line for line in describe_missing(solve_state([], setting, LIMITS)))
    square = [target_pose(middle_mm=(x, 0.0, z)) for x, z in ((-20, 300), (0, 330), (20, 360))]
    said = " ".join(describe_missing(state_of(setting, square, np.random.default_rng(0))))
    assert "3 images, at least 8" in said and "% of the image is covered" in said
    assert "never tilted away by 12 deg: the target's right side, left side, lower side, upper side" in said


def test_a_sheet_without_stripes_is_missing(advised):
    assert advised.solution is not None
    assert "the laser line is on the target in 0 of 6 images" in describe_missing_sheet(advised)[0]


def test_an_image_that_contradicts_the_others_is_refused_with_its_residual(setting, advised):
    state = advised
    rng = np.random.default_rng(2)
    wish = best_pose(state)
    right = RecordedPose(seen(setting, wish.candidate.pose, rng), NO_STRIPE, 9.0)
    assert not judge_residual(state.solution, solve_state([*state.recorded, right], setting, LIMITS).solution)
    # A plate that is bent by 1 mm over its width.
    points = BOARD.points_mm
    bent = points - np.column_stack([np.zeros((len(points), 2)), ((points[:, 0] - 60) / 60) ** 2])
    pixels = lens_of(setting.sensor).pixels(bent @ wish.candidate.pose[:3, :3].T + wish.candidate.pose[:3, 3])
    wrong = RecordedPose(replace(right.view, pixels=pixels), NO_STRIPE, 9.0)
    reasons = judge_residual(state.solution, solve_state([*state.recorded, wrong], setting, LIMITS).solution)
    assert reasons and reasons[0].startswith("contradicts the others: with it the residual is ")


def test_in_a_medium_the_camera_seems_longer(thesis):
    water = nominal_camera(Setting(thesis, BOARD, thesis.medium("water"), "free"))
    air = nominal_camera(Setting(thesis, BOARD, thesis.medium("air"), "free"))
    assert water.fx_px == pytest.approx(1.3312 * air.fx_px, rel=1e-3)
    pose = target_pose(tilt_deg=(10, 5), middle_mm=(-20, 10, 350.0))
    points = BOARD.points_mm
    pixels = cv2.projectPoints(points, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], air.matrix(), None)[0][:, 0]
    view = TargetView(pixels, points, np.zeros((len(points), 2), int), {})
    np.testing.assert_allclose(estimate_pose(view, air), pose, atol=1e-4)


# The step standard


def step_image(sensor: Sensor, profile_mm: np.ndarray, *, gain: float = 1.0) -> np.ndarray:
    """Drawn laser line of a profile in the OCS, in water."""
    u, v = through_window(sensor, profile_mm).T
    order = np.argsort(u)
    centre = np.interp(np.arange(sensor.camera.width_px), u[order], v[order], left=np.nan, right=np.nan)
    across = np.arange(sensor.camera.height_px)[:, None] - centre
    line = np.nan_to_num(150.0 * np.exp(-0.5 * (across / 2.0) ** 2))
    return np.clip(np.rint(gain * line + np.random.default_rng(0).normal(4, 1, line.shape)), 0, 255).astype(np.uint8)


def test_the_step_standard_is_judged(thesis):
    calibration = nominal_calibration(thesis).model_copy(update={"window": None})
    window = WindowModel.from_description(thesis.camera.window, thesis.laser.wavelength_nm)

    def judge(image):
        standard = StepStandard(height_mm=STEP_MM)
        return judge_step(image, calibration, window, standard, medium_index=WATER, full_dn=FULL)

    good = judge(step_image(thesis, step_profile(0.0)))
    # The origin of the OCS is the stand-off in air, 265 mm / tan 35 deg from the pupil; the base is there, the block
    # 23 mm before it, and nearly half of the line on either.
    base = 265 / np.tan(np.radians(35)) - window.distance_mm - window.thickness_mm
    assert good.reasons == () and base - 25 < good.depth_mm < base + 2
    assert any("no step" in reason for reason in judge(step_image(thesis, step_profile(0.0, height_mm=0.0))).reasons)
    assert any("saturated" in reason for reason in judge(step_image(thesis, step_profile(0.0), gain=5.0)).reasons)
    dark = judge(step_image(thesis, step_profile(0.0), gain=0.0))
    assert dark.depth_mm is None and "0 lines only" in dark.reasons[0]
    other = judge(np.zeros((64, 64)))
    assert other.pixels.shape == (0, 2) and other.depth_mm is None and "float64" in other.reasons[0]


def test_the_step_standard_is_wanted_at_three_depths(thesis):
    # The measuring volume reaches from 200 to 420 mm; a seventh of it is 31 mm.
    assert next_depth_mm([330.0], thesis) == pytest.approx(200 + 220 / 6)
    assert next_depth_mm([282.0], thesis) == pytest.approx(200 + 220 * 5 / 6)
    assert not is_separate_depth(300.0, [282.0], thesis) and is_separate_depth(314.0, [282.0], thesis)
    assert select_separate_depths([282.0, 282.5, 319.0, 381.0], thesis) == [282.0, 319.0, 381.0]
    assert next_depth_mm([282.0, 282.5, 319.0, 381.0], thesis) is None


def test_a_depth_that_is_skipped_gives_way_to_the_next_in_turn(thesis):
    third = 220 / 6
    # Farthest from 330 mm is the near third, then the far one, then the middle one, and the near one again.
    asked = [next_depth_mm([330.0], thesis, skipped=count) for count in range(4)]
    assert asked == pytest.approx([200 + third, 200 + 5 * third, 200 + 3 * third, 200 + third])
    assert len({next_depth_mm([], thesis, skipped=count) for count in range(3)}) == 3
    assert next_depth_mm([282.0, 319.0, 381.0], thesis, skipped=1) is None


def test_blur_does_not_depend_on_which_side_of_a_point_is_bright() -> None:
    """An image, mirrored, and upside down: the window about a point reaches as far on every side."""
    rng = np.random.default_rng(9)
    image = rng.integers(0, 255, (61, 81)).astype(np.uint8)
    u, v = np.array([20, 40, 61]), np.array([30, 17, 44])
    blur = edge_blur_px(image, np.column_stack([u, v]), half_px=4.0)
    assert edge_blur_px(image[:, ::-1], np.column_stack([80 - u, v]), half_px=4.0) == pytest.approx(blur, rel=1e-5)
    assert edge_blur_px(image[::-1], np.column_stack([u, 60 - v]), half_px=4.0) == pytest.approx(blur, rel=1e-5)
