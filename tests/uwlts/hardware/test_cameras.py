"""Frame check, addresses, replay, and a missing camera library."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from uwlts.errors import HardwareError, ImageError, SetupError
from uwlts.hardware.aravis import AravisCamera
from uwlts.hardware.camera_interface import CameraDevice, FrameCheck, FrameCounts, FrameStatus, ReplayCamera
from uwlts.hardware.scanning import open_camera
from uwlts.model.sensor import Sensor
from uwlts.runtime import optional_library
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

SHORT, DUPLICATED, DROPPED, LATE, OK = FrameStatus


def judged(frames: list[tuple[int, float | None, bool]], *, period_s: float | None = None, triggered: bool = False):
    """Status of each (number, time, complete), and the counts."""
    check = FrameCheck(period_s=period_s, triggered=triggered)
    statuses = [check.judge(frame_id=number, time_s=at, complete=whole) for number, at, whole in frames]
    return statuses, check.counts


@pytest.mark.parametrize(
    ("frames", "statuses", "counts"),
    [
        ([(7, 0.0, True), (8, 0.1, True), (9, 0.2, True)], [OK, OK, OK], FrameCounts(ok=3)),
        ([(1, 0.0, True), (4, 0.3, True)], [OK, DROPPED], FrameCounts(ok=1, dropped=2)),
        ([(1, 0.0, True), (2, 0.1, False), (3, 0.2, True)], [OK, SHORT, OK], FrameCounts(ok=2, short=1)),
        ([(1, 0.0, True), (3, 0.2, False)], [OK, SHORT], FrameCounts(ok=1, short=1, dropped=1)),
        ([(1, 0.0, True), (1, 0.1, True)], [OK, DUPLICATED], FrameCounts(ok=1, duplicated=1)),
        ([(1, 0.0, True), (2, 0.0, True)], [OK, DUPLICATED], FrameCounts(ok=1, duplicated=1)),
        ([(5, 0.5, True), (4, 0.4, True), (6, 0.6, True)], [OK, LATE, OK], FrameCounts(ok=2, late=1)),
        ([(1, 0.0, True), (2, 0.21, True)], [OK, LATE], FrameCounts(ok=1, late=1)),
        ([(1, 0.0, True), (2, 0.19, True)], [OK, OK], FrameCounts(ok=2)),
        # Counters of 16 bits restart at 1 or at 0.
        ([(65535, 0.0, True), (1, 0.1, True), (2, 0.2, True)], [OK, OK, OK], FrameCounts(ok=3)),
        ([(65535, 0.0, True), (0, 0.1, True), (1, 0.2, True)], [OK, OK, OK], FrameCounts(ok=3)),
        ([(65534, 0.0, True), (2, 0.3, True)], [OK, DROPPED], FrameCounts(ok=1, dropped=2)),
        ([(65535, 0.0, True), (65536, 0.1, True)], [OK, OK], FrameCounts(ok=2)),
        # A number that jumps or restarts is no loss where the time stamps leave no room for one.
        ([(1, 0.0, True), (40, 0.1, True), (41, 0.2, True)], [OK, OK, OK], FrameCounts(ok=3, renumbered=1)),
        ([(1, 0.0, True), (40, 0.3, True)], [OK, DROPPED], FrameCounts(ok=1, dropped=2, renumbered=1)),
        ([(57, 0.0, True), (1, 0.1, True), (2, 0.2, True)], [OK, OK, OK], FrameCounts(ok=3, renumbered=1)),
        # Faster than stated: there was time for the lost frame.
        ([(1, 0.0, True), (2, 0.06, True), (4, 0.18, True)], [OK, OK, DROPPED], FrameCounts(ok=2, dropped=1)),
        ([(57, 0.0, True), (1, 0.4, True)], [OK, LATE], FrameCounts(ok=1, late=1, renumbered=1)),
    ],
)
def test_each_fault_has_its_name_and_is_counted(frames, statuses, counts):
    assert judged(frames, period_s=0.1) == (statuses, counts)


@pytest.mark.parametrize("times_s", [(0.0, 7.0, 9.0), (None, None, None)])
def test_an_answered_trigger_lost_no_frame_whatever_its_number(times_s):
    frames = [(number, time_s, True) for number, time_s in zip((3, 9, 10), times_s, strict=True)]
    assert judged(frames, triggered=True) == ([OK, OK, OK], FrameCounts(ok=3, renumbered=1))
    assert judged([(9, 1.0, True), (3, 0.5, True)], triggered=True)[0] == [OK, LATE]


def test_without_a_period_or_time_stamps_nothing_is_late_or_equal():
    assert judged([(1, 0.0, True), (2, 99.0, True)])[0] == [OK, OK]
    assert judged([(1, None, True), (2, None, True)], period_s=0.1)[0] == [OK, OK]


def test_after_an_unanswered_trigger_the_count_may_restart():
    check = FrameCheck()
    check.judge(frame_id=8, time_s=1.0, complete=True)
    check.restart_comparison("unanswered")
    assert check.judge(frame_id=1, time_s=2.0, complete=True) is OK
    assert check.counts == FrameCounts(ok=2, unanswered=1)


@pytest.mark.parametrize("address", ["", "gige", "usb:1", "genicam:a.cti", "replay:", "0"])
def test_an_unknown_address_lists_the_known_ones(address):
    with pytest.raises(HardwareError, match=r"(?s)not a camera address.*gige:NAME.*replay:PATH"):
        open_camera(address)


def pictures(folder: Path, count: int, *, suffix: str = ".png", kind: type = np.uint8) -> Path:
    """A folder of images that contain their number; sorted as texts, 10 would precede 2."""
    folder.mkdir()
    for number in range(count):
        image = np.arange(24 * 32, dtype=kind).reshape(24, 32) % 251
        image[0, 0] = number
        assert cv2.imwrite(str(folder / f"image-{number}{suffix}"), image)
    return folder


def first_pixels(camera: CameraDevice, count: int) -> list[int]:
    return [int(camera.grab(1.0).image[0, 0]) for _ in range(count)]


@pytest.mark.parametrize(("suffix", "kind"), [(".png", np.uint8), (".tif", np.uint16), (".BMP", np.uint8)])
def test_a_folder_is_shown_in_the_order_of_its_numbers(tmp_path, suffix, kind):
    folder = pictures(tmp_path / "f", 12, suffix=suffix, kind=kind)
    (folder / "notes.txt").write_text("no image")
    with open_camera(f"replay:{folder}") as camera:
        assert (camera.info.width_px, camera.info.height_px, camera.info.bits) == (32, 24, 8 * np.dtype(kind).itemsize)
        assert camera.configure(exposure_ms=4.0).exposure_ms == 4.0
        camera.start()
        frame = camera.grab(1.0)
        assert frame.image.dtype == kind and frame.exposure_ms == 4.0
        assert first_pixels(camera, 11) == list(range(1, 12))
        with pytest.raises(HardwareError, match="all 12 images of .* have been shown"):
            camera.grab(1.0)
        assert camera.counts == FrameCounts(ok=12)


def test_a_replay_can_be_triggered(tmp_path):
    with ReplayCamera(pictures(tmp_path / "f", 3)) as camera:
        settings = camera.configure(trigger="software", frame_rate_hz=10.0)
        assert (settings.frame_rate_hz, settings.exposure_ms, settings.gain_db) == (None, None, None)
        camera.start()
        with pytest.raises(HardwareError, match="did not answer a trigger within 0.01 s"):
            camera.grab(0.01)
        for expected in range(3):
            camera.trigger()
            assert first_pixels(camera, 1) == [expected]
        assert camera.counts == FrameCounts(ok=3, unanswered=1)


def test_a_frame_nobody_fetched_is_thrown_away_by_the_next_trigger(tmp_path):
    with ReplayCamera(pictures(tmp_path / "f", 3)) as camera:
        camera.configure(trigger="software")
        camera.start()
        camera.trigger()
        camera.trigger()
        assert first_pixels(camera, 1) == [1]
        assert camera.counts == FrameCounts(ok=1, late=1)


def test_a_capture_is_shown_with_its_exposures(tmp_path, thesis: Sensor):
    small = thesis.camera.model_copy(update={"width_px": 32, "height_px": 16})
    header = CaptureHeader(
        name="small",
        sensor=thesis.model_copy(update={"camera": small}),
        medium_name="air",
        medium=thesis.medium("air"),
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    path = tmp_path / "small.h5"
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number in range(3):
            writer.append(Frame(np.full((16, 32), number, np.uint8), 0.0, True, 2.0 + number, float(number)))
    with open_camera(f"replay:{path}") as camera:
        assert (camera.info.width_px, camera.info.height_px, camera.info.bits) == (32, 16, thesis.detector.bits)
        assert camera.configure(exposure_ms=9.0).exposure_ms == 2.0
        camera.start()
        frames = [camera.grab(1.0) for _ in range(3)]
    assert [frame.exposure_ms for frame in frames] == [2.0, 3.0, 4.0]
    assert [int(frame.image[0, 0]) for frame in frames] == [0, 1, 2]


def test_what_cannot_be_replayed_is_said(tmp_path):
    with pytest.raises(HardwareError, match="neither a folder of images nor a capture"):
        open_camera(f"replay:{tmp_path / 'missing'}")
    with pytest.raises(HardwareError, match="contains no image"):
        open_camera(f"replay:{tmp_path}")
    folder = pictures(tmp_path / "f", 2)
    (folder / "image-1.png").write_bytes((folder / "image-1.png").read_bytes()[:40])
    with ReplayCamera(folder) as camera:
        for wish, message in (
            ({"bits": 12}, "images of 8 bits, not 12"),
            ({"gain_db": 3.0}, "has no gain"),
            ({"exposure_ms": 0.0}, "exposure_ms is 0.0: expected a positive number"),
        ):
            with pytest.raises(HardwareError, match=message):
                camera.configure(**wish)
        camera.configure()
        camera.start()
        camera.grab(1.0)
        with pytest.raises(ImageError, match="image-1.png is a PNG file that is truncated"):
            camera.grab(1.0)
    cv2.imwrite(str(folder / "image-1.png"), np.zeros((24, 31), np.uint8))
    with ReplayCamera(folder) as camera:
        camera.configure()
        camera.start()
        camera.grab(1.0)
        with pytest.raises(ImageError, match="image 1 .* has 31 x 24 px of uint8, the first one 32 x 24"):
            camera.grab(1.0)
    cv2.imwrite(str(folder / "image-0.png"), np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(ImageError, match="expected a grey image"):
        open_camera(f"replay:{folder}")


def test_calls_in_the_wrong_order_are_refused(tmp_path):
    camera = ReplayCamera(pictures(tmp_path / "f", 2))
    for call, message in ((camera.configure, "call open"), (camera.start, "call configure")):
        with pytest.raises(HardwareError, match=message):
            call()
    with pytest.raises(HardwareError, match="call start"):
        camera.grab(1.0)
    with camera:
        camera.configure()
        camera.start()
        for call, message in (
            (camera.configure, "call stop"),
            (camera.start, "running already"),
            (camera.trigger, "trigger 'free'"),
        ):
            with pytest.raises(HardwareError, match=message):
                call()
        camera.stop()
        camera.stop()
    camera.close()
    with pytest.raises(HardwareError, match="call open"):
        _ = camera.info


class FeatureCamera(AravisCamera):
    """Features of a camera without the library; locked ones ignore what is set."""

    def __init__(self, features: dict[str, bool | int | float], locked: str = ""):
        super().__init__("x")
        self.features, self.locked = features, locked

    def _call(self, name: str, *arguments: Any) -> Any:
        feature = arguments[0].decode()
        if name == "is_feature_available":
            return feature in self.features
        kinds = {"get_boolean": bool, "set_boolean": bool, "get_float": float, "set_float": float}
        if type(self.features[feature]) is not kinds.get(name, int):
            raise HardwareError("Not a ArvGcFloat")
        if name.startswith("set_") and feature != self.locked:
            self.features[feature] = arguments[1]
        return self.features[feature]


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ({"ReverseX": True, "ReverseY": False}, "ReverseX was 1 and is now 0"),
        ({"BinningVertical": 2, "Gamma": 0.45}, "BinningVertical was 2 and is now 1, Gamma was 0.45 and is now 1"),
        ({"GammaEnable": True, "Gamma": 0.45}, "GammaEnable was 1 and is now 0:"),
        ({"ReverseX": False, "Gamma": 1.0, "BinningHorizontal": 1}, None),
        # Types of other makers: integers in place of switches, choices from a list.
        ({"ReverseX": 1}, "ReverseX was 1 and is now 0"),
        ({"ReverseX": 0, "BinningVertical": 0}, None),
        ({"Gamma": 1}, "Gamma is choice 1: check that images are linear in light"),
        ({}, None),
    ],
)
def test_images_are_as_on_the_image_sensor_and_linear_in_light(features, said, caplog):
    camera = FeatureCamera(features)
    camera._set_plain()
    if not isinstance(features.get("Gamma"), int):
        camera._set_plain()
    assert [said in record.getMessage() for record in caplog.records] == [True] * (said is not None)


def test_a_black_level_that_is_an_integer_is_recorded():
    assert FeatureCamera({"BlackLevel": 7})._access("get", "BlackLevel") == 7
    assert FeatureCamera({})._access("get", "BlackLevel") is None


def test_a_camera_that_stays_mirrored_is_refused():
    with pytest.raises(HardwareError, match="has ReverseX = 1, and does not accept 0: change it in the camera's own"):
        FeatureCamera({"ReverseX": True}, locked="ReverseX")._set_plain()


def test_a_missing_aravis_is_said_with_what_to_install(monkeypatch, tmp_path):
    optional_library.load_aravis.cache_clear()
    monkeypatch.setenv(optional_library.ARAVIS_VARIABLE, str(tmp_path / "libaravis.so"))
    with pytest.raises(SetupError, match=r"UWLTS_LIBARAVIS names .*libaravis.so"):
        open_camera("gige:1")
    monkeypatch.setenv(optional_library.ARAVIS_VARIABLE, "libc.so.6")
    with pytest.raises(SetupError, match="lacks arv_camera_new"):
        open_camera("gige:1")
    monkeypatch.delenv(optional_library.ARAVIS_VARIABLE)
    monkeypatch.setattr(optional_library, "ARAVIS", "libaravis-0.0.so.0")
    with pytest.raises(SetupError, match=r"(?s)libaravis-0.0.so.0: .*apt-get install libaravis-0.8-0"):
        open_camera("gige:1")
    optional_library.load_aravis.cache_clear()
