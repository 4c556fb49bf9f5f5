"""Simulated recordings: repeatable, resumable after an interruption, never overwritten by default, nominal headers."""

import subprocess
import sys

import numpy as np
import pytest

import twin
from tests.virtual_sensors import altered, plate, scene_of
from twin.recording.record_scene import record_scene
from twin.recording.render import choose_scene
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import NONE, Options
from twin.scene.description import Scene, load_scene
from uwlts.errors import CaptureError, DescriptionError, OutputError
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture
from uwlts.storage.truth import TruthStatus, read_truth, scene_digest, truth_path

FRAMES = 6
OPTIONS = Options(spp=16, seed=11)


@pytest.fixture(scope="module")
def small(thesis) -> Sensor:
    """The middle of the thesis's view in 80 x 64 pixels, four times as large as the real ones."""
    return altered(thesis, {"camera": {"width_px": 80, "height_px": 64, "pixel_size_um": 21.2}})


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A plate behind a sphere, a lamp and a laser image at three positions."""
    sphere = {"kind": "sphere", "diameter_mm": 30.0, "position_mm": (0.0, 4.0, 3.0)}
    motion = {"start_mm": -4.0, "step_mm": 4.0, "count": 3, "lights": ("lamp", "laser")}
    return scene_of(sphere, plate(15.0), motion=motion)


@pytest.fixture(scope="module")
def undisturbed(small, scene, tmp_path_factory):
    """Path of a recording made in one go."""
    path = tmp_path_factory.mktemp("undisturbed") / "scan.h5"
    record_scene(scene, small, path, options=OPTIONS)
    return path


def stop_after(frames: int):
    """A progress callback during which the user interrupts."""

    def progress(done: int, total: int) -> None:
        assert total == FRAMES
        if done == frames:
            raise KeyboardInterrupt

    return progress


def assert_same(first, second) -> None:
    """Captures, truth and headers of two recordings are equal in everything."""
    with Capture(first) as a, Capture(second) as b:
        assert len(a) == len(b) == FRAMES
        assert a.header == b.header
        for index in range(FRAMES):
            np.testing.assert_array_equal(a.image(index), b.image(index))
        for name in ("stage_mm", "pose", "laser_on", "exposure_ms", "time_s"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    (header_a, truth_a), (header_b, truth_b) = read_truth(truth_path(first)), read_truth(truth_path(second))
    assert header_a == header_b
    for name, value in vars(truth_a).items():
        np.testing.assert_array_equal(value, getattr(truth_b, name))


def test_a_recording_holds_every_shot_in_its_order(undisturbed, small, scene):
    with Capture(undisturbed) as capture:
        assert capture.finished
        assert len(capture) == FRAMES
        assert capture.laser_on.tolist() == [False, True] * 3
        assert capture.stage_mm.tolist() == [-4.0, -4.0, 0.0, 0.0, 4.0, 4.0]
        assert (np.diff(capture.time_s) > 0).all()
        assert capture.header.sensor == small
        assert capture.header.provenance["seed"] == 11
        assert capture.header.provenance["scene"] == scene_digest(read_truth(truth_path(undisturbed))[0].scene)
        images = [capture.image(index) for index in range(FRAMES)]
        exposure = capture.exposure_ms
    assert all(image.shape == (64, 80) and image.dtype == np.uint8 for image in images)
    # Automatic exposure brings the brightest to 0.8 of full scale; the shot noise of 8000 electrons is 1 % of it.
    assert all(150 <= image.max() <= 255 for image in images)
    assert len(set(exposure[::2])) == len(set(exposure[1::2])) == 1
    header, truth = read_truth(truth_path(undisturbed))
    assert Scene.model_validate(header.scene) == scene
    assert truth.centre_px.shape == (FRAMES, 80)
    assert truth.point_mm.shape == (FRAMES, 80, 3)
    assert (truth.status[::2] == TruthStatus.NO_STRIPE).all(), "lamp images show no stripe"
    assert (truth.status[1::2] == TruthStatus.VISIBLE).mean() > 0.5
    assert truth.depth_mm.shape == (64, 80)


def test_the_stripe_is_bright_where_the_truth_has_it(undisturbed):
    _, truth = read_truth(truth_path(undisturbed))
    with Capture(undisturbed) as capture:
        for index in (1, 3, 5):
            image = capture.image(index)
            lines = np.flatnonzero(truth.status[index] == TruthStatus.VISIBLE)
            centre = np.rint(truth.centre_px[index, lines]).astype(int)
            brightest = image[:, lines].argmax(axis=0)
            # A pixel is 0.9 mm wide, wider than the stripe; near the edge of two pixels noise decides the brighter.
            assert (np.abs(brightest - centre) <= 1).mean() > 0.95


def test_one_seed_gives_one_recording(undisturbed, small, scene, tmp_path):
    record_scene(scene, small, tmp_path / "scan.h5", options=OPTIONS)
    assert_same(tmp_path / "scan.h5", undisturbed)


def test_another_seed_gives_other_noise_and_the_same_truth(undisturbed, small, scene, tmp_path):
    path = tmp_path / "scan.h5"
    record_scene(scene, small, path, options=Options(spp=16, seed=12))
    with Capture(path) as other, Capture(undisturbed) as capture:
        differ = [(other.image(index) != capture.image(index)).mean() for index in range(FRAMES)]
    assert min(differ) > 0.1
    np.testing.assert_array_equal(
        read_truth(truth_path(path))[1].centre_px, read_truth(truth_path(undisturbed))[1].centre_px
    )


def test_ideal_recordings_have_no_noise(small, scene, tmp_path):
    frames = []
    for seed in (1, 2):
        path = tmp_path / f"ideal-{seed}.h5"
        record_scene(scene, small, path, options=Options(spp=16, seed=seed, effects=NONE))
        with Capture(path) as capture:
            frames.append([capture.image(index).astype(int) for index in range(FRAMES)])
    for one, two in zip(*frames, strict=True):
        np.testing.assert_array_equal(one, two)
    # Away from the stripe a laser image shows the black level and nothing else.
    assert (np.median(frames[0][1]), frames[0][1].min()) == (2, 2)


@pytest.mark.parametrize(
    "frames", [pytest.param(1, marks=pytest.mark.slow), 4, pytest.param(6, marks=pytest.mark.slow)]
)
def test_an_interrupted_recording_goes_on_where_it_stopped(undisturbed, small, scene, tmp_path, frames):
    path, part = tmp_path / "scan.h5", tmp_path / "scan.h5.part"
    with pytest.raises(KeyboardInterrupt):
        record_scene(scene, small, path, options=OPTIONS, progress=stop_after(frames))
    assert not path.exists()
    assert not truth_path(path).exists()
    with Capture(part) as unfinished, Capture(undisturbed) as whole:
        assert not unfinished.finished
        assert len(unfinished) == frames
        for index in range(frames):
            np.testing.assert_array_equal(unfinished.image(index), whole.image(index))
    with pytest.raises(OutputError, match="resume"):
        record_scene(scene, small, path, options=OPTIONS)
    with pytest.raises(CaptureError, match="belongs to another recording"):
        record_scene(scene, small, path, options=Options(spp=16, seed=12), resume=True)
    moved = choose_scene(scene, placement=None, medium=None, water=1.0)
    with pytest.raises(CaptureError, match=r"plan\.scene\.water is .* in it, 1.0 now"):
        record_scene(moved, small, path, options=OPTIONS, resume=True)
    record_scene(scene, small, path, options=OPTIONS, resume=True)
    assert not part.exists()
    assert_same(path, undisturbed)


def test_existing_files_are_replaced_only_when_asked(small, scene, tmp_path):
    path = tmp_path / "scan.h5"
    record_scene(scene, small, path, options=OPTIONS)
    with Capture(path) as capture:
        before = capture.image(1)
    truth = truth_path(path).read_bytes()
    with pytest.raises(OutputError, match=r"scan.*h5 exists already"):
        record_scene(scene, small, path, options=Options(spp=4, seed=99))
    truth_path(path).unlink()
    with pytest.raises(OutputError, match=r"scan\.h5 exists already"):
        record_scene(scene, small, path, options=Options(spp=4, seed=99))
    truth_path(path).write_bytes(truth)
    with Capture(path) as capture:
        np.testing.assert_array_equal(capture.image(1), before)
    record_scene(scene, small, path, options=Options(spp=4, seed=99), overwrite=True)
    with Capture(path) as capture:
        assert (capture.image(1) != before).any()


def test_the_capture_states_the_drawings_and_the_truth_the_sensor_as_built(small, tmp_path):
    scene = scene_of(plate(15.0), motion={"count": 1, "lights": ("lamp",)})
    built = altered(small, {"camera": {"focal_length_mm": 12.9}, "laser": {"roll_deg": 0.3}})
    path = tmp_path / "scan.h5"
    record_scene(scene, small, path, as_built=built, options=Options(spp=4, effects=NONE))
    with Capture(path) as capture:
        assert capture.header.sensor == small
        assert capture.header.medium == small.media["water"]
    assert read_truth(truth_path(path))[0].sensor == built


def test_a_missing_folder_is_refused(small, scene, tmp_path):
    with pytest.raises(OutputError, match="absent does not exist"):
        record_scene(scene, small, tmp_path / "absent" / "scan.h5", options=OPTIONS)


def test_images_rendered_into_arrays_are_those_of_the_file(small, scene, undisturbed):
    recording = twin.render(scene, sensor=small, spp=OPTIONS.spp, seed=OPTIONS.seed, frames=(3, 4))
    _, truth = read_truth(truth_path(undisturbed))
    with Capture(undisturbed) as capture:
        for place, index in enumerate((3, 4)):
            np.testing.assert_array_equal(recording.images[place], capture.image(index))
            np.testing.assert_array_equal(recording.truth.centre_px[place], truth.centre_px[index])
        for name in ("stage_mm", "laser_on", "exposure_ms", "time_s"):
            np.testing.assert_array_equal(getattr(recording, name), np.asarray(getattr(capture, name))[[3, 4]])
    assert recording.sensor == small and recording.medium == small.media["water"]


def test_simulate_writes_what_the_description_gives(small, scene, undisturbed, tmp_path):
    lines = []
    out = tmp_path / "{placement}.h5"
    paths = twin.simulate(scene, out=out, sensor=small, spp=OPTIONS.spp, seed=OPTIONS.seed, report=lines.append)
    assert paths == [tmp_path / f"{scene.placement}.h5"] and lines == [f"wrote {paths[0]}"]
    with Capture(undisturbed) as first, Capture(paths[0]) as second:
        for index in range(FRAMES):
            np.testing.assert_array_equal(first.image(index), second.image(index))


def test_frames_beyond_the_scan_and_several_placements_in_one_file_are_refused(small, scene, tmp_path):
    with pytest.raises(DescriptionError, match="numbers from 0 to 5"):
        twin.render(scene, sensor=small, frames=(6,))
    with pytest.raises(DescriptionError, match="put {placement} into its name"):
        twin.simulate(scene, sensor=small, out=tmp_path / "a.h5", placement=("near", "far"))


def test_the_package_offers_its_functions_without_importing_the_renderer():
    script = (
        "import sys, twin; twin.render, twin.simulate, twin.demo\n"
        "assert not {'mitsuba', 'drjit'} & set(sys.modules)\n"
        "try: twin.absent\nexcept AttributeError as error: print(error)"
    )
    child = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "No twin attribute absent"


def test_images_of_a_target_do_not_depend_on_earlier_ones():
    coarse = {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 21.2}}
    sensor, scene = altered(load_sensor("thesis-small"), coarse), load_scene("target-through-window")
    shots = list(scene.motion.shots())[:4]
    assert [shot.light for shot in shots] == ["lamp", "laser"] * 2
    used = SensorSimulator(sensor, scene, Options(spp=4))
    images = [used.frame(shot, number).image for number, shot in enumerate(shots)]
    for number in (2, 3):
        fresh = SensorSimulator(sensor, scene, Options(spp=4))
        np.testing.assert_array_equal(images[number], fresh.frame(shots[number], number).image)
        assert np.ptp(images[number]) > 50
