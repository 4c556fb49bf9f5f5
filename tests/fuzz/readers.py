"""All readers of external files, each with a small valid file made by the program itself."""

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import laspy
import numpy as np
import trimesh
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from tests.uwlts.mount_views import sphere_campaign
from tests.uwlts.storage.drawn_captures import a_header, interrupted, record, small_sensor
from tests.uwlts.storage.test_cloud import some_cloud, some_uncertainty
from tests.uwlts.storage.test_ros_bags import messages, write_ros2
from tests.uwlts.storage.test_truth import a_header as truth_header, a_truth
from tests.uwlts.storage.test_vendor_files import BLOCK
from twin.datasets.data_set import load_description as load_data_set
from twin.design.study import load_study
from twin.design.sweep import encode_part, read_parts
from twin.experiments.figures import load_published
from twin.scene.campaign import load_campaign
from twin.scene.description import Mesh, load_scene
from twin.scene.finish import read_grey
from twin.scene.objects import _load_surface
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.mount.calibrate_mount import calibrate_mount
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.comparison.change_reference import read_datums, read_reference, read_shape
from uwlts.desk.guided_plan import load_guided_plan
from uwlts.evaluation.evaluate import read_evaluation
from uwlts.hardware.scan_plan import load_plan
from uwlts.model.artefacts import resolve_artefact
from uwlts.model.library import library_folder, load_sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.report.certificate import check_certificate, make_certificate
from uwlts.report.file_description import describe
from uwlts.storage.calibration_file import describe_verification, load_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.cloud_files import read_cloud, write_cloud
from uwlts.storage.data_set import Sample, ShardReader, load_dataset, open_shard
from uwlts.storage.figure_table import FigureTable, MeasuredFigure, read_figures
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.camera_files import read_intrinsics, set_intrinsics
from uwlts.storage.import_.folder_description import capture_header, described_sensor, read_description, read_header
from uwlts.storage.import_.matching import read_rows
from uwlts.storage.mount_files import read_mount, read_profiles
from uwlts.storage.pose_files import read_trajectory
from uwlts.storage.truth import read_truth, write_truth


@dataclass(frozen=True)
class Reader:
    """Reader, suffix of its files, function that makes a valid file, and format for mutations."""

    name: str
    suffix: str
    form: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]


def seed_of(reader: Reader, folder: Path) -> bytes:
    """Return the content of the reader's valid file."""
    path = folder / f"seed{reader.suffix}"
    if not path.exists():
        reader.make(path)
    return path.read_bytes()


@cache
def _joint_text() -> str:
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
    series = target_series(built_sensor(), medium=0, positions=np.arange(4) * 50.0 - 100.0, noise=noise, columns=15)
    options = CalibrationOptions(poses="stage", correct_circles=False)
    solved = solve_jointly(gathered(load_sensor("thesis"), [series]), options=options)
    return json.dumps({"format": "uwlts-calibration", "version": 1} | solved.calibration.model_dump(mode="json"))


def _joint(path: Path) -> None:
    path.write_text(_joint_text())


def _nominal(path: Path) -> None:
    nominal_calibration(load_sensor("thesis")).save(path)


def _certified(path: Path) -> Path:
    """Write the joint calibration of a certificate beside it."""
    beside = path.with_name("certified.json")
    if not beside.exists():
        _joint(beside)
    return beside


def _certificate(path: Path) -> None:
    calibration = _certified(path)
    content = make_certificate(load_calibration(calibration), calibration, issued="2026-01-02T03:04:05+00:00")
    path.write_text(json.dumps(content.in_file()))


def _polynomials(path: Path) -> None:
    count, degree = 4, 2
    medium = load_sensor("thesis").media["water"].model_dump(mode="json")
    content = {"format": "uwlts-polynomials", "version": 1, "sensor_name": "a", "stripe_along": "width"}
    content |= {"wavelength_nm": 635.0, "medium_name": "water", "medium": medium, "window_mounted": True}
    content |= {"width_px": 64, "height_px": 48, "degree": degree, "first_line": 3}
    content |= {"position_range_px": [1.0, 40.0], "depth_range_mm": [200.0, 300.0]}
    content |= {"domains_px": [[2.0, 30.0]] * count, "residuals": {"depth": {"rms_mm": 0.1}}}
    content |= {name: [[1.5] * (degree + 1)] * count for name in ("depth_coefficients", "along_coefficients")}
    path.write_text(json.dumps(content))


def _evaluation(path: Path) -> None:
    artefact = {"kind": "pipe", "diameter_mm": 300.0}
    content = {"format": "uwlts-evaluation", "version": 1, "cloud": "a.ply", "artefact": artefact, "medium_index": 1.33}
    path.write_text(
        json.dumps(content | {"uncertainty": {"D": dict.fromkeys(("random_mm", "systematic_mm", "expanded_mm"), 0.1)}})
    )


def _cloud(path: Path) -> None:
    write_cloud(path, some_cloud(uncertainty=some_uncertainty()))


def _plain_cloud(path: Path) -> None:
    write_cloud(path, some_cloud(6))


def _text_cloud(path: Path) -> None:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 3\n{names}end_header\n1 2 3\n4 5 6\n7 8 9\n")


def _foreign(path: Path) -> None:
    write_cloud(path, some_cloud())


def _verification(path: Path) -> None:
    record = {"format": "uwlts-verification", "version": 1, "calibration": "a", "date": "2026-01-02T03:04:05+00:00"}
    path.write_text(json.dumps(record | {"capture": "a.h5", "passed": True, "lines": ["diameter: 50 mm"]}))


def _verified(path: Path) -> None:
    describe_verification(
        path.with_name(path.name.replace(".verification", "")), nominal_calibration(load_sensor("thesis"))
    )


def _las(path: Path) -> None:
    table = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    table.x, table.y, table.z = 1e-3 * some_cloud().points_mm.T
    table.write(path)


def _old_laz(path: Path) -> None:
    table = laspy.LasData(laspy.LasHeader(version="1.2", point_format=3))
    table.x, table.y, table.z = 1e-3 * some_cloud().points_mm.T
    table.write(path)


def _sensor_with(path: Path) -> None:
    """Read a camera and put it into a sensor."""
    set_intrinsics(small_sensor(640, 480), read_intrinsics(path), source=path.name)


def _exported(path: Path) -> None:
    """Read a cloud and export it to other formats."""
    cloud = read_cloud(path)
    for suffix in (".xyz", ".laz", ".e57"):
        write_cloud(path.with_name(f"exported{suffix}"), cloud, overwrite=True)


def _all_of_capture(path: Path) -> None:
    with Capture(path) as capture:
        for _ in capture:
            pass


def _capture(path: Path) -> None:
    record(path, 3)


def _unfinished(path: Path) -> None:
    interrupted(path.with_name("left.h5"), 3)
    path.with_name("left.h5.part").rename(path)


def _import_description(path: Path) -> None:
    text = 'sensor = "thesis"\nmedium = "water"\nlaser = "*laser*"\nlamp = ["*lamp*", "b*"]\nchannel = "red"\n'
    text += "bits = 10\n[stage]\nstart_mm = 0.5\nstep_mm = 0.1\ndirection = [1, 0, 0]\n"
    path.write_text(text + '[target]\nkind = "chessboard"\ncolumns = 9\nrows = 6\nsquare_mm = 15\n')


def _read_import(path: Path) -> None:
    given = read_description(path)
    sensor = described_sensor(given, beside=path.parent)
    capture_header(given, sensor, beside=path.parent, name="a", saturation_dn=255, remarks={})


def _header(path: Path) -> None:
    path.write_text(a_header().model_dump_json())


def _plan(path: Path) -> None:
    text = 'title = "A scan"\nsensor = "thesis"\nmedium = "water"\nlights = ["lamp", "laser"]\nlaser_ms = 5.0\n'
    path.write_text(text + "[stage]\nstart_mm = 1.0\nstep_mm = 0.5\ncount = 5\ndirection = [0.6, 0.0, 0.8]\n")


def _shipped(name: str) -> Callable[[Path], object]:
    return lambda path: path.write_bytes((library_folder() / name).read_bytes())


def _text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def _artefact(path: Path) -> None:
    path.write_text('kind = "pipe"\ndiameter_mm = 300.0\ndiameter_uncertainty_mm = 0.01\n')


def _table(path: Path) -> None:
    path.write_text("file,light,stage_mm,exposure_ms,time_s\na1.png,laser,1.0,2.5,0\na2.png,lamp,1.5,2.5,1\n")


def _mount(path: Path) -> None:
    campaign = sphere_campaign(np.random.default_rng(3), poses=8)
    calibrate_mount(campaign.profiles, campaign.poses, radius_mm=20.0).save(path)


def _trajectory(path: Path) -> None:
    path.write_text("time_s,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n0.5,1.5,2,3,0.6,0,0,0.8\n")


def _profiles(path: Path) -> None:
    path.write_text("pose;x;z;time_s\n1;0,5;2,5;0,1\n1;;;0,1\n2;0,5;2,25;0,2\n")


_CAMERA = """image_width: 640
image_height: 480
camera_matrix:
  rows: 3
  cols: 3
  data: [800.0, 0.0, 320.0, 0.0, 801.0, 240.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, -0.002, 0.0]
"""


def _ros(path: Path) -> None:
    path.write_text(_CAMERA)


def _opencv(path: Path) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array([[800.0, 0, 320], [0, 801, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 0.001, -0.002, 0.0]]))
    storage.release()


def _picture(path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def _mesh(path: Path) -> None:
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in ((1, 2, 3), (1, 2, 4), (1, 3, 4), (2, 3, 4)))
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n{faces}")


def _read_mesh(path: Path) -> None:
    _load_surface(Mesh(kind="mesh", path=str(path)))


def _glb(path: Path) -> None:
    trimesh.Scene(trimesh.creation.box()).export(path)


def _part(path: Path) -> None:
    number = np.arange(40)
    path.write_bytes(encode_part({"design": number, "line_mm": 150.0 + number, "failure": np.full(40, "")}))


def _read_part(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "part-000000.parquet").symlink_to(path.absolute())
        read_parts(Path(folder))


def _figures(path: Path) -> None:
    rows = {"campaign": "campaign-0", "scan": "spheres", "method": "joint", "figure": "SSE"}
    FigureTable(rows=(MeasuredFigure(**rows, true_mm=99.18, measured_mm=99.2, expanded_mm=0.03),)).save(path)


def _guided_plan(path: Path) -> None:
    text = 'title = "A calibration"\nsensor = "thesis"\nposes = "stage"\n[stage]\nfirst_mm = 1.0\nlast_mm = 90.0\n'
    path.write_text(text + 'count = 5\n[target]\nkind = "chessboard"\ncolumns = 9\nrows = 6\nsquare_mm = 15\n')


def _surface(path: Path) -> None:
    trimesh.creation.box((9.0, 9.0, 9.0)).export(path)


def _read_surface(path: Path) -> None:
    """Read a mesh as a reference of a comparison."""
    # Large discs have few samples, whose memory has its own limit.
    read_reference(path, unit="mm", disc_mm=1e9)


def _big_endian(path: Path) -> None:
    vertices = np.zeros(9, [("x", ">f8"), ("y", ">f4"), ("z", ">i4")])
    vertices["x"], vertices["z"] = np.arange(9), 7
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 9\n"
    header += "property double x\nproperty float y\nproperty int z\nend_header\n"
    path.write_bytes(header.encode() + vertices.tobytes())


def _tum(path: Path) -> None:
    path.write_text("# timestamp tx ty tz qx qy qz qw\n1.7e9 1 2 3 0 0 0 1\n1700000001.5 1 2 3 0.6 0 0 0.8\n")


def _covariances(path: Path) -> None:
    names = [f"cov_{i}{j}" for i in range(6) for j in range(i, 6)]
    rows = [",".join([str(k), *(str(v) for v in np.eye(4)[:3].ravel()), *["0.25"] * 21]) for k in range(3)]
    matrix = [f"m{i}{j}" for i in range(3) for j in range(4)]
    path.write_text("\n".join([",".join(["time_s", *matrix, *names]), *rows]) + "\n")


def _bag(path: Path) -> None:
    """Write a recording of poses: of ROS 1, or of ROS 2 in the storage of the suffix."""
    kind = "geometry_msgs/msg/PoseStamped"
    if path.suffix == ".bag":
        types = get_typestore(Stores.ROS1_NOETIC)
        with BagWriter(path) as bag:
            connection = bag.add_connection("/pose", kind, typestore=types)
            for message in messages(types, kind):
                bag.write(connection, 1, types.serialize_ros1(message, kind))
        return
    storage = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    with tempfile.TemporaryDirectory() as folder:
        made = write_ros2(Path(folder) / "bag", {"/pose": kind}, storage)
        shutil.copyfile(next(made.glob(f"*{path.suffix}")), path)


def _shard(path: Path) -> None:
    image, centre = np.zeros((4, 6), np.uint8), np.zeros(6, np.float32)
    with open_shard(path) as shard:
        for key in ("a", "b"):
            shard.add(Sample(key, image, {"centre_px": centre}, {"frame": 1}))


def _read_shard(path: Path) -> None:
    reader = ShardReader(path, frames=2)
    for number in range(2):
        reader.sample(number, None)


def _card(path: Path) -> None:
    shard = {"name": "train-0.tar", "split": "train", "frames": 2, "sha256": "a" * 64}
    content = dict.fromkeys(("title", "notes", "licence"), "a") | {"seed": 1, "redrawn": 0}
    content |= {"versions": {"uwlts": "1"}, "image": {"width_px": 6}, "scenes": {"train": 1}, "frames": {"train": 2}}
    content |= {"labels": {"centre_px": "a"}, "drawn": {"a": {"mean": 1.0}}, "status": {"ok": 3}, "description": {}}
    path.write_text(json.dumps({"format": "uwlts-dataset", "version": 2} | content | {"shards": [shard]}))


def _read_card(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "dataset.json").symlink_to(path.absolute())
        load_dataset(folder)


READERS = {
    each.name: each
    for each in (
        Reader("calibration", ".json", "json", _nominal, load_calibration),
        Reader("joint", ".json", "json", _joint, load_calibration),
        Reader("polynomials", ".json", "json", _polynomials, load_calibration),
        Reader("certificate", ".json", "json", _certificate, lambda path: check_certificate(path, _certified(path))),
        Reader("evaluation", ".json", "json", _evaluation, read_evaluation),
        Reader("header", ".json", "json", _header, read_header),
        Reader("described", ".json", "json", _nominal, describe),
        Reader("capture", ".h5", "hdf5", _capture, _all_of_capture),
        Reader("unfinished", ".h5.part", "hdf5", _unfinished, _all_of_capture),
        Reader("cloud-hdf5", ".h5", "hdf5", _cloud, read_cloud),
        Reader("truth", ".truth.h5", "hdf5", lambda path: write_truth(path, truth_header(), a_truth()), read_truth),
        Reader("cloud-ply", ".full.ply", "lines", _cloud, read_cloud),
        Reader("cloud-text", ".ply", "lines", _text_cloud, read_cloud),
        Reader("export", ".ply", "lines", _plain_cloud, _exported),
        *(
            Reader(f"cloud-{kind}", f".{kind}", form, make, read_cloud)
            for kind, form, make in (("xyz", "lines", _foreign), ("las", "bytes", _las), ("e57", "bytes", _foreign))
        ),
        Reader("cloud-laz", ".laz", "bytes", _foreign, read_cloud),
        Reader("cloud-laz-1.2", ".laz", "bytes", _old_laz, read_cloud),
        Reader("cloud-block", ".csv", "lines", _text(BLOCK.format(";") + "X;Y;Z\n" + 12 * "1,5;2;3\n"), read_cloud),
        Reader("verification", ".verification.json", "json", _verification, _verified),
        Reader("sensor", ".toml", "toml", _shipped("sensors/thesis.toml"), load_sensor),
        Reader("sensor-shown", ".toml", "toml", _shipped("sensors/thesis.toml"), describe),
        Reader("scene", ".toml", "toml", _shipped("spheres.toml"), load_scene),
        Reader("campaign", ".toml", "toml", _shipped("campaigns/demo.toml"), load_campaign),
        Reader("study", ".toml", "toml", _shipped("studies/baseline-angle.toml"), load_study),
        Reader("plan", ".toml", "toml", _plan, lambda path: load_plan(path).header("a")),
        Reader("artefact", ".toml", "toml", _artefact, resolve_artefact),
        Reader("import", ".toml", "toml", _import_description, _read_import),
        Reader("table", ".csv", "lines", _table, read_rows),
        Reader("mount", ".json", "json", _mount, read_mount),
        Reader(
            "trajectory",
            ".csv",
            "lines",
            _trajectory,
            lambda path: read_trajectory(path, pose_format="quaternion-xyzw"),
        ),
        Reader("profiles", ".csv", "lines", _profiles, read_profiles),
        Reader("intrinsics-ros", ".yaml", "lines", _ros, _sensor_with),
        Reader("intrinsics-opencv", ".yml", "lines", _opencv, _sensor_with),
        Reader("intrinsics-xml", ".xml", "lines", _opencv, _sensor_with),
        *(Reader(f"image-{kind}", f".{kind}", "image", _picture, read_image) for kind in ("png", "tif", "bmp", "jpg")),
        Reader("mesh", ".obj", "lines", _mesh, _read_mesh),
        Reader("mesh-binary", ".glb", "bytes", _glb, _read_mesh),
        Reader("texture", ".png", "image", _picture, read_grey),
        *(
            Reader(f"surface-{kind}", f".{kind}", form, _surface, _read_surface)
            for kind, form in (("ply", "bytes"), ("stl", "bytes"), ("obj", "lines"))
        ),
        Reader("cloud-big-endian", ".ply", "lines", _big_endian, read_cloud),
        *(
            Reader(f"bag-{kind}", f".{kind}", "bytes", _bag, lambda path: read_trajectory(path, pose_format="ros"))
            for kind in ("bag", "mcap", "db3")
        ),
        Reader("tum", ".txt", "lines", _tum, lambda path: read_trajectory(path, pose_format="tum")),
        Reader("covariances", ".csv", "lines", _covariances, read_trajectory),
        Reader("shard-tar", ".tar", "bytes", _shard, _read_shard),
        Reader("card", ".json", "json", _card, _read_card),
        Reader("data-set", ".toml", "toml", _shipped("datasets/stripe-turbid.toml"), load_data_set),
        Reader(
            "shape",
            ".toml",
            "toml",
            _text('kind = "cylinder"\npoint_mm = [1, 2, 3]\naxis = [0, 0, 1]\ndiameter_mm = 5\n'),
            read_shape,
        ),
        Reader("datums", ".toml", "toml", _text("[[datum]]\ncentre_mm = [1, 2, 3]\nradius_mm = 5\n"), read_datums),
        Reader("screened", ".parquet", "bytes", _part, _read_part),
        Reader("figures", ".json", "json", _figures, read_figures),
        Reader("guided-plan", ".toml", "toml", _guided_plan, load_guided_plan),
        Reader("published", ".toml", "toml", _shipped("references/thesis-tables.toml"), load_published),
    )
}
