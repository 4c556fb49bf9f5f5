"""Camera calibrations of OpenCV and ROS in all common notations; other files are refused."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from uwlts.errors import DescriptionError
from uwlts.model.calibration import CameraModel
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Distortion
from uwlts.optics.camera import directions, project
from uwlts.storage.import_.camera_files import KnownCamera, read_intrinsics, set_intrinsics

MATRIX = np.array([[2451.25, 0.0, 640.5], [0.0, 2450.75, 511.25], [0.0, 0.0, 1.0]])
COEFFICIENTS = np.array([-0.125, 0.0625, 1e-3, -2e-3, 0.03125])
KNOWN = KnownCamera(
    fx_px=2451.25,
    fy_px=2450.75,
    cx_px=640.5,
    cy_px=511.25,
    size_px=(1280, 1024),
    distortion=Distortion(k1=-0.125, k2=0.0625, p1=1e-3, p2=-2e-3, k3=0.03125),
)

ROS = """\
image_width: 1280
image_height: 1024
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [2451.25, 0.000000, 640.5, 0, 2450.75, 511.25, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.125, 0.0625, 0.001, -2.0e-03, 0.03125]
projection_matrix:
  rows: 3
  cols: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
"""

KALIBR = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.125, 0.0625, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [2451.25, 2450.75, 640.5, 511.25]
  resolution: [1280, 1024]
  rostopic: /cam0/image_raw
"""

MESSAGE = """\
header:
  seq: 0
  stamp:
    secs: 0
  frame_id: "camera"
height: 1024
width: 1280
distortion_model: "plumb_bob"
D: [-0.125, 0.0625, 0.001, -0.002, 0.03125]
K: [2451.25, 0.0, 640.5, 0.0, 2450.75, 511.25, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
roi:
  do_rectify: False
---
"""


def read(tmp_path: Path, text: str) -> KnownCamera:
    (tmp_path / "camera.yaml").write_text(text)
    return read_intrinsics(tmp_path / "camera.yaml")


def written(path: Path, entries: dict[str, object]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
@pytest.mark.parametrize(
    ("matrix", "coefficients"),
    [
        ("camera_matrix", "distortion_coefficients"),
        ("cameraMatrix", "distCoeffs"),
        ("Camera_Matrix", "dist_coeffs"),
        ("Camera_Matrix", "Distortion_Coefficients"),
        ("K", "D"),
        ("M1", "D1"),
    ],
)
def test_files_of_opencv(tmp_path: Path, suffix: str, matrix: str, coefficients: str):
    # As a row or as a column.
    shaped = COEFFICIENTS.reshape(1, 5) if matrix == "K" else COEFFICIENTS.reshape(5, 1)
    entries = {"image_width": 1280, "image_height": 1024, "flags": 0, matrix: MATRIX, coefficients: shaped}
    assert read_intrinsics(written(tmp_path / f"camera.{suffix}", entries)) == KNOWN


@pytest.mark.parametrize(
    "text",
    [
        *(ROS, MESSAGE, MESSAGE.replace("D:", "d:").replace("K:", "k:"), f"%YAML:1.0\n---\n{ROS}"),
        # Names that state no foreign model.
        *(
            f"{ROS}{more}\n"
            for more in ("camera_model: acA1920-40gm", "model: Pinhole", "type: mono", "fisheye: false")
        ),
    ],
)
def test_files_of_ros(tmp_path: Path, text: str):
    assert read(tmp_path, text) == KNOWN


def test_longer_models_pass_where_they_say_no_more(tmp_path: Path):
    entries = {"K": MATRIX, "D": np.r_[COEFFICIENTS, np.zeros(3)]}
    known = read_intrinsics(written(tmp_path / "camera.yaml", entries))
    assert known.distortion == KNOWN.distortion and known.size_px is None
    rational = {"K": MATRIX, "D": np.r_[COEFFICIENTS, 0.25, -0.125, 0.5, np.zeros(4)]}
    eight = read_intrinsics(written(tmp_path / "eight.yaml", rational))
    assert eight.distortion == KNOWN.distortion.model_copy(update={"k4": 0.25, "k5": -0.125, "k6": 0.5})
    four = read_intrinsics(written(tmp_path / "four.yaml", {"K": MATRIX, "D": COEFFICIENTS[:4]}))
    assert four.distortion == KNOWN.distortion.model_copy(update={"k3": 0.0})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (ROS.replace("plumb_bob", "equidistant"), "an equidistant lens has 4 coefficients, k1 to k4; found 5"),
        (
            ROS.replace("plumb_bob", "rational_polynomial").replace("0.03125]", "0.03125, 0, 0, 0, 0.1, 0, 0, 0]"),
            "12 coefficients .thin prism or tilted sensor",
        ),
        (ROS.replace("0.03125]", "0.03125, 0]"), "there are 6 distortion coefficients"),
        (ROS.replace("camera_matrix", "matrix"), "has none of cameramatrix, .* it has imagewidth"),
        (ROS.replace("distortion_coefficients", "bends"), "has none of distortioncoefficients"),
        (ROS.replace("data: [2451.25, 0.000000", "data: [2451.25, 3.0"), "expected fx 0 cx, 0 fy cy, 0 0 1"),
        (ROS.replace("data: [2451.25", "data: [-2451.25"), "with positive fx, fy"),
        (ROS.replace("data: [2451.25, ", "data: ["), "has 8 elements; expected 3 x 3"),
        (ROS.replace("2451.25", "wide"), "expected numbers"),
        (ROS.replace("2451.25", ".nan"), "expected a finite number"),
        (ROS.replace("1280", "many"), "image size is 'many' x 1024"),
        (ROS[: ROS.index("640.5")], "no valid YAML"),
        ("[1, 2, 3]\n", "holds no table"),
        ("", "holds no table"),
        ("%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  data: [ 1., 0.", "no valid YAML"),
        ("<?xml version='1.0'?>\n<opencv_storage><K>1. 0. 0.", "no complete XML"),
        ("<?xml version='1.0'?>\n<!DOCTYPE a [<!ENTITY b 'c'>]>\n<a>&b;</a>", "declares a type of document"),
        ("<?xml version='1.0'?>\n" + 200 * "<a>" + 200 * "</a>", "nests its elements"),
        # Foreign lens models, by their names.
        (KALIBR.replace("radtan", "fov"), "another lens model, distortion_model: fov"),
        (KALIBR.replace("pinhole", "omni"), "another lens model, camera_model: omni"),
        (KALIBR.replace("pinhole", "ds"), "another lens model, camera_model: ds"),
        (KALIBR.replace("pinhole", "eucm"), "another lens model, camera_model: eucm"),
        (KALIBR + KALIBR.replace("cam0:", "cam1:"), "has 2 cameras .cam0, cam1.; expected one"),
        (KALIBR.replace("[2451.25, ", "[0.5, 2451.25, "), "there are 5 intrinsics; expected fx, fy, cx, cy"),
        (ROS + "fisheye_model: 1\n", "two lens models, distortion_model: plumb_bob and fisheye_model: 1"),
        (ROS + "fisheye: true\n", "two lens models, distortion_model: plumb_bob and fisheye: True"),
        (ROS.replace("plumb_bob", "Inverse Brown Conrady"), "distortion_model: Inverse Brown Conrady"),
        (ROS + "model: OPENCV_FISHEYE\n", "two lens models, distortion_model: plumb_bob and model: OPENCV_FISHEYE"),
        (ROS + "Camera.type: KannalaBrandt8\n", "another lens model, Camera.type: KannalaBrandt8"),
        (ROS + "xi: 1.2\n", "another lens model, xi: 1.2"),
    ],
)
def test_what_is_no_such_camera(tmp_path: Path, text: str, words: str):
    with pytest.raises(DescriptionError, match=words):
        read(tmp_path, text)


def test_a_file_of_kalibr(tmp_path: Path):
    assert read(tmp_path, KALIBR) == replace(KNOWN, distortion=KNOWN.distortion.model_copy(update={"k3": 0.0}))


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_the_fisheye_mark_of_opencv(tmp_path: Path, suffix: str):
    entries = {"K": MATRIX, "D": COEFFICIENTS, "image_width": 1280, "image_height": 1024}
    assert read_intrinsics(written(tmp_path / f"pinhole.{suffix}", entries | {"fisheye_model": 0})) == KNOWN
    with pytest.raises(DescriptionError, match="an equidistant lens has 4 coefficients, k1 to k4; found 5"):
        read_intrinsics(written(tmp_path / f"fisheye.{suffix}", entries | {"fisheye_model": 1}))
    fisheye = read_intrinsics(written(tmp_path / f"four.{suffix}", entries | {"D": FISHEYE, "fisheye_model": 1}))
    _images_like_opencvs_fisheye(fisheye, FISHEYE)


FISHEYE = np.array([-0.0081, 0.042, -0.039, 0.0071])
OF_FISHEYE = ROS.replace("[-0.125, 0.0625, 0.001, -2.0e-03, 0.03125]", str(FISHEYE.tolist()))
WIDE = OF_FISHEYE.replace("2451.25", "720.5").replace("2450.75", "720.5")


def _images_like_opencvs_fisheye(known: KnownCamera, coefficients: np.ndarray) -> None:
    """Points of all angles in the image, projected by `cv2.fisheye` and by the converted camera."""
    width, height = known.size_px or (1280, 1024)
    matrix = np.array([[known.fx_px, 0, known.cx_px], [0, known.fy_px, known.cy_px], [0, 0, 1.0]])
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 41)), axis=2).reshape(-1, 2)
    plane = cv2.fisheye.undistortPoints(pixels[:, None], matrix, coefficients)[:, 0]
    points = np.column_stack([plane, np.ones(len(plane))])
    seen = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    camera = CameraModel(width_px=width, height_px=height, **_focal(known), distortion=known.distortion)
    assert np.linalg.norm(seen - pixels, axis=1).max() < 0.01
    assert np.linalg.norm(project(camera, points) - seen, axis=1).max() < 0.025
    rays = directions(camera, seen)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, rtol=1e-3, atol=1e-6)


def _focal(known: KnownCamera) -> dict[str, float]:
    return {name: getattr(known, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}


@pytest.mark.parametrize(
    "text",
    [
        WIDE.replace("plumb_bob", "equidistant"),
        WIDE.replace("plumb_bob", "fisheye"),
        WIDE.replace("distortion_model: plumb_bob", "model: OPENCV_FISHEYE"),
        KALIBR.replace("radtan", "equidistant").replace("[-0.125, 0.0625, 0.001, -0.002]", str(FISHEYE.tolist())),
    ],
    ids=["ros", "ros-fisheye", "opencv", "kalibr"],
)
def test_equidistant_lenses_are_converted(tmp_path: Path, text: str):
    """Also one whose corners are 69 deg from the axis."""
    _images_like_opencvs_fisheye(read(tmp_path, text), FISHEYE)


@pytest.mark.parametrize(
    ("focal", "words"),
    [
        ("600.0", "corners at 78 deg from the axis.* departs from it by .* px, at most 0.02 px"),
        ("300.0", "images angles up to 89 deg, and the image's"),
    ],
)
def test_equidistant_lenses_wider_than_the_model_are_refused(tmp_path: Path, focal: str, words: str):
    text = WIDE.replace("plumb_bob", "equidistant").replace("720.5", focal)
    text = text.replace(str(FISHEYE.tolist()), "[0.0, 0.0, 0.0, 0.0]")
    with pytest.raises(DescriptionError, match=words):
        read(tmp_path, text)


def test_the_region_of_a_camera_info_moves_the_principal_point(tmp_path: Path):
    """K is that of the whole image sensor (sensor_msgs/CameraInfo); images of a region begin at its corner."""

    def with_region(text: str) -> KnownCamera:
        return read(tmp_path, MESSAGE.replace("  do_rectify: False\n", text))

    whole = with_region("  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\nbinning_x: 1\n")
    region = "  x_offset: 256\n  y_offset: 128\n  height: 600\n  width: 800\n"
    found = with_region(region)
    assert found == replace(
        whole, cx_px=whole.cx_px - 256, cy_px=whole.cy_px - 128, size_px=(800, 600), offset_px=(256, 128)
    )
    sensor = load_sensor("thesis")
    cropped = sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"width_px": 800, "height_px": 600})})
    assert set_intrinsics(cropped, found, source="a").camera.offset_px == (256, 128)
    elsewhere = cropped.model_copy(update={"camera": cropped.camera.model_copy(update={"offset_px": (0, 0)})})
    with pytest.raises(DescriptionError, match=r"from \(256, 128\) px of the image sensor"):
        set_intrinsics(elsewhere, found, source="a")
    for text, words in (
        ("  x_offset: 0\nbinning_x: 2\n", "binned pixels"),
        (region.replace("800", "0"), "expected its offsets and its size"),
        (region.replace("256", "left"), "expected whole numbers"),
    ):
        with pytest.raises(DescriptionError, match=words):
            with_region(text)


def test_a_missing_or_binary_file(tmp_path: Path):
    with pytest.raises(DescriptionError, match="no intrinsics at"):
        read_intrinsics(tmp_path / "camera.yaml")
    (tmp_path / "camera.yaml").write_bytes(b"\x80\xff")
    with pytest.raises(DescriptionError, match="is not a file of intrinsics: it is no text"):
        read_intrinsics(tmp_path / "camera.yaml")


def test_the_sensor_takes_them_over():
    sensor = load_sensor("thesis")
    filled = set_intrinsics(sensor, KNOWN, source="camera.yaml")
    assert filled.camera.focal_lengths_px() == pytest.approx((2451.0, 2451.0), rel=1e-12)
    assert filled.camera.principal_point() == (640.5, 511.25) and filled.camera.distortion == KNOWN.distortion
    assert filled.laser == sensor.laser and filled.media == sensor.media
    oblong = set_intrinsics(sensor, replace(KNOWN, fy_px=2500.0), source="camera.yaml")
    assert oblong.camera.focal_lengths_px() == pytest.approx((KNOWN.fx_px, 2500.0), rel=1e-12)


def test_intrinsics_of_another_camera_are_refused():
    sensor = load_sensor("thesis")
    other = KnownCamera(2451.0, 2451.0, 512.0, 640.0, Distortion(), (1024, 1280))
    with pytest.raises(DescriptionError, match="1024 x 1280 pixels, the sensor's are 1280 x 1024"):
        set_intrinsics(sensor, other, source="camera.yaml")
    oblong = KnownCamera(2000.0, 2500.0, 640.0, 512.0, Distortion(), None)
    with pytest.raises(DescriptionError, match=r"pixel_aspect.*1\.25"):
        set_intrinsics(sensor, oblong, source="camera.yaml")
