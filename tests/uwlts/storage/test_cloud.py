"""Cloud files keep all bits, outputs are written completely or not at all, and damaged files are refused."""

import errno
import os
import resource
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from trimesh.exchange.ply import _parse_header, _ply_binary

from tests.system.in_process import uwlts
from tests.uwlts import drawn_stripes
from uwlts.errors import CaptureError, OutputError
from uwlts.files.writing import write_atomically
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud, PointUncertainty
from uwlts.storage.cloud_files import is_cloud, read_cloud, read_thinned_cloud, write_cloud

KINDS = pytest.mark.parametrize("name", ["a.full.ply", "a.h5"])


def some_cloud(count: int = 40, **changes) -> PointCloud:
    rng = np.random.default_rng(3)
    values = {
        "points_mm": rng.normal(scale=300.0, size=(count, 3)),
        "intensity": rng.random(count),
        "frame": np.arange(count) // 7,
        "line": np.arange(count) * 3,
        "deviation_mm": np.where(np.arange(count) % 5, rng.normal(size=count), np.nan),
        "metadata": {"medium": "water", "nested": {"n": [1.3315, 2, None, True]}},
    }
    return PointCloud(**{**values, **changes})


def some_uncertainty(count: int = 40, patterns: int = 3) -> PointUncertainty:
    rng = np.random.default_rng(5)
    shapes = {"random_mm2": (count, 6), "patterns_mm": (patterns, count, 3), "poses_mm": (6, count, 3)}
    names = [part.name for part in fields(PointUncertainty) if part.name != "shared"]
    arrays = {name: rng.normal(size=shapes.get(name, (count, 3))).astype(np.float32) for name in names}
    arrays["random_mm2"] = np.abs(arrays["random_mm2"])
    return PointUncertainty(**arrays, shared={"sensor": rng.normal(size=(patterns, 5)).round(6)})


@KINDS
def test_a_cloud_comes_back_bit_by_bit(tmp_path, name):
    cloud = some_cloud(uncertainty=some_uncertainty(), time_s=1.7e9 + np.arange(40) / 7)
    write_cloud(tmp_path / name, cloud)
    back = read_cloud(tmp_path / name)
    assert len(back) == 40
    for field, kind in (
        ("points_mm", np.float64),
        ("intensity", np.float32),
        ("frame", np.int32),
        ("line", np.int32),
        ("deviation_mm", np.float32),
        ("time_s", np.float64),
    ):
        assert getattr(back, field).dtype == kind
        np.testing.assert_array_equal(getattr(back, field), getattr(cloud, field))
    for part in fields(PointUncertainty):
        found, written = (getattr(each.uncertainty, part.name) for each in (back, cloud))
        if part.name == "shared":
            assert found.keys() == written.keys() and np.array_equal(found["sensor"], written["sensor"])
        else:
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found, written)
    assert back.metadata == cloud.metadata
    assert os.listdir(tmp_path) == [name]
    assert is_cloud(tmp_path / name)


@KINDS
@pytest.mark.parametrize("known", [False, True])
def test_of_a_large_cloud_every_nth_point_is_read(tmp_path, name, known):
    cloud = some_cloud(1001, uncertainty=some_uncertainty(1001) if known else None)
    write_cloud(tmp_path / name, cloud)
    thinned, total = read_thinned_cloud(tmp_path / name, 150)
    assert (len(thinned), total) == (143, 1001)
    for field in ("points_mm", "intensity", "frame", "line", "deviation_mm"):
        np.testing.assert_array_equal(getattr(thinned, field), getattr(cloud, field)[::7])
    if known:
        np.testing.assert_allclose(thinned.covariance_mm2, cloud.covariance_mm2[::7], rtol=1e-5)
    assert thinned.metadata == cloud.metadata
    assert len(read_thinned_cloud(tmp_path / name, 1001)[0]) == len(read_thinned_cloud(tmp_path / name)[0]) == 1001


@pytest.mark.slow
@KINDS
def test_a_cloud_larger_than_memory_allows_is_read_thinned(tmp_path, name):
    """Two million points take 72 MB as arrays alone; some of them are read within 40 MB."""
    count = 2_000_000
    points = np.arange(3.0 * count).reshape(-1, 3)
    write_cloud(tmp_path / name, PointCloud(points, np.zeros(count), np.zeros(count, int), np.zeros(count, int)))
    program = (
        "import resource, sys\nfrom uwlts.storage.cloud_files import read_thinned_cloud\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024\n"
        "before = peak()\ncloud, total = read_thinned_cloud(sys.argv[1], 100_000)\n"
        "print(len(cloud), total, cloud.points_mm[-1, 0], peak() - before)"
    )
    done = subprocess.run([sys.executable, "-c", program, tmp_path / name], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    read, total, last, grown_mb = done.stdout.split()
    assert (int(read), int(total), float(last)) == (100_000, count, 3.0 * (count - 20))
    assert int(grown_mb) < 40


@pytest.mark.parametrize("name", ["random_mm2", "position_mm", "patterns_mm", "poses_mm"])
@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e13])
def test_uncertainties_that_are_no_numbers_are_refused(name: str, value: float):
    known = some_uncertainty()
    numbers = getattr(known, name).copy()
    numbers[..., -1, 0] = value
    with pytest.raises(CaptureError, match=f"{name} of the cloud's uncertainty has numbers that are not finite"):
        some_cloud(uncertainty=replace(known, **{name: numbers}))


def test_negative_variances_are_refused():
    known = some_uncertainty()
    numbers = known.random_mm2.copy()
    numbers[3, 5] = -1e-6
    with pytest.raises(CaptureError, match="negative variances"):
        some_cloud(uncertainty=replace(known, random_mm2=numbers))


@KINDS
@pytest.mark.parametrize("wrong", [5, {"sensor": [[1.0]]}, {"sensor": "words"}])
def test_damage_to_what_clouds_share_is_refused(tmp_path, name, wrong):
    write_cloud(
        tmp_path / name,
        some_cloud(uncertainty=replace(some_uncertainty(), shared={}), metadata={"shared_errors": wrong}),
    )
    with pytest.raises(CaptureError, match="shared_errors"):
        read_cloud(tmp_path / name)


@KINDS
def test_a_cloud_without_points_deviation_or_uncertainty_comes_back(tmp_path, name):
    write_cloud(tmp_path / f"none-{name}", PointCloud(np.zeros((0, 3)), [], [], []))
    assert len(read_cloud(tmp_path / f"none-{name}")) == 0
    write_cloud(tmp_path / name, some_cloud(deviation_mm=None))
    back = read_cloud(tmp_path / name)
    assert back.deviation_mm is None
    assert back.uncertainty is None


def test_both_files_hold_the_systematic_covariance_for_other_programs(tmp_path):
    cloud = some_cloud(uncertainty=some_uncertainty())
    for name in ("a.full.ply", "a.h5"):
        write_cloud(tmp_path / name, cloud)
    vertices = read_by_trimesh(tmp_path / "a.full.ply")
    pairs = [f"systematic_{pair}" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")]
    with h5py.File(tmp_path / "a.h5") as file:
        assert dict(file.attrs)["format"] == b"uwlts-cloud"
        np.testing.assert_array_equal(file["systematic_mm2"], np.stack([vertices[pair] for pair in pairs], axis=1))


def test_captures_and_clouds_in_hdf5_are_distinguished(tmp_path):
    capture = drawn_stripes.write(tmp_path / "capture.h5", [])
    write_cloud(tmp_path / "cloud.h5", some_cloud())
    assert not is_cloud(capture)
    with pytest.raises(CaptureError, match=r"its format is 'uwlts-capture', expected 'uwlts-cloud'"):
        read_cloud(capture)
    with pytest.raises(CaptureError, match=r"its format is 'uwlts-cloud', expected 'uwlts-capture'"):
        Capture(tmp_path / "cloud.h5")


def test_a_cloud_in_hdf5_goes_through_the_commands(tmp_path):
    write_cloud(tmp_path / "a.h5", some_cloud(uncertainty=some_uncertainty()))
    assert "cloud of 40 points from 6 frames" in uwlts("info", tmp_path / "a.h5").stdout
    assert uwlts("export", tmp_path / "a.h5", "--out", tmp_path / "b.full.ply").returncode == 0
    assert uwlts("export", tmp_path / "b.full.ply", "--out", tmp_path / "c.h5").returncode == 0
    back = read_cloud(tmp_path / "c.h5")
    np.testing.assert_array_equal(back.points_mm, some_cloud().points_mm)
    np.testing.assert_array_equal(back.uncertainty.patterns_mm, some_uncertainty().patterns_mm)
    refused = uwlts("export", drawn_stripes.write(tmp_path / "d.h5", []), "--out", tmp_path / "d.h5")
    assert refused.returncode == 2


def replaced(name, change):
    """Return a damage that replaces an array of a file by another one."""

    def damage(file):
        values = change(file[name][:])
        del file[name]
        file[name] = values

    return damage


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda file: file.__delitem__("line"), "has no line"),
        (lambda file: file.__delitem__("random_mm2"), "has no random_mm2"),
        (replaced("intensity", lambda values: np.array([b"one"] * len(values))), "'intensity' are no numbers"),
        (replaced("frame", lambda values: values[:-1]), "frame has the shape"),
        (lambda file: file.attrs.__setitem__("version", 99), "has version 99"),
    ],
)
def test_a_damaged_cloud_in_hdf5_is_refused(tmp_path, damage, message):
    path = tmp_path / "damaged.h5"
    write_cloud(path, some_cloud(uncertainty=some_uncertainty()))
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(CaptureError, match=message) as refusal:
        read_cloud(path)
    assert "damaged.h5" in str(refusal.value)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@settings(deadline=None, max_examples=40)
@given(metadata=st.dictionaries(st.text(), JSON, max_size=5), blanks=st.integers(0, 1000))
def test_any_metadata_comes_back_through_short_ascii_lines(tmp_path_factory, metadata, blanks):
    # The run of blanks puts every kind of character at the end of a comment.
    metadata = {**metadata, "blanks": "x" + " " * blanks + "\n"}
    path = tmp_path_factory.mktemp("metadata") / "a.ply"
    for each in (path, path.with_suffix(".h5")):
        write_cloud(each, some_cloud(3, metadata=metadata))
        assert read_cloud(each).metadata == metadata
    header = path.read_bytes().split(b"end_header\n")[0]
    # rply, the reader of CloudCompare and others, refuses comments of 1024 characters.
    assert max(len(line) for line in header.split(b"\n")) < 1024
    assert header.isascii()


def test_the_header_is_what_other_programs_expect(tmp_path):
    write_cloud(tmp_path / "a.ply", some_cloud())
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in header if not line.startswith("comment")][2:] == [
        "element vertex 40",
        "property double x",
        "property double y",
        "property double z",
        "property float intensity",
        "property float deviation",
        "property int frame",
        "property int line",
    ]


def read_by_trimesh(path: Path) -> np.ndarray:
    """Vertices of a file as another library reads them."""
    with path.open("rb") as file:
        elements, _, _ = _parse_header(file)
        _ply_binary(elements, file)
    return elements["vertex"]["data"]


def write_by_hand(path: Path, vertices: np.ndarray, *, faces=(), text: bool = False) -> None:
    """Write a file as the format prescribes, big-endian or text, with polygons of any number of corners."""
    names = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}
    kinds = {name: vertices.dtype[name] for name in vertices.dtype.names}
    lines = ["ply", f"format {'ascii' if text else 'binary_big_endian'} 1.0", f"element vertex {len(vertices)}"]
    for name, kind in kinds.items():
        listed = f"list uchar {names[kind.base.str[1:]]}" if kind.shape else names[kind.str[1:]]
        lines.append(f"property {listed} {name}")
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"] if faces else []
    content = "\n".join([*lines, "end_header", ""]).encode()
    for row in vertices:
        for name, kind in kinds.items():
            values = np.atleast_1d(row[name])
            if text:
                content += b" ".join(str(value).encode() for value in values) + b" "
            else:
                content += (
                    bytes([len(values)] if kind.shape else []) + values.astype(kind.base.newbyteorder(">")).tobytes()
                )
        content += b"\n" if text else b""
    for face in faces:
        words = " ".join(map(str, [len(face), *face])) + "\n"
        content += words.encode() if text else bytes([len(face)]) + np.array(face, ">i4").tobytes()
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["f4", "f8", "i4"])
@pytest.mark.parametrize("text", [False, True])
def test_files_of_other_programs_need_only_positions(tmp_path, kind, text):
    vertices = np.array([(1, 2, 3, 255), (4, 5, 6, 0)], dtype=[("z", kind), ("x", kind), ("y", kind), ("red", "u1")])
    write_by_hand(tmp_path / "foreign.ply", vertices, faces=[[0, 1, 0], [1, 0, 1, 0]], text=text)
    cloud = read_cloud(tmp_path / "foreign.ply")
    np.testing.assert_array_equal(cloud.points_mm, [[2, 3, 1], [5, 6, 4]])
    assert cloud.points_mm.dtype == np.float64
    assert np.isnan(cloud.intensity).all()
    assert (cloud.frame == -1).all() and (cloud.line == -1).all()
    assert cloud.deviation_mm is None and cloud.metadata == {}


def test_fields_saved_again_by_cloudcompare_are_recognised(tmp_path):
    names = ["x", "y", "z", "scalar_intensity", "scalar_frame", "scalar_line"]
    vertices = np.array([(1, 2, 3, 0.5, 7, 9)], dtype=[(name, "f4") for name in names])
    write_by_hand(tmp_path / "cc.ply", vertices)
    cloud = read_cloud(tmp_path / "cc.ply")
    assert (cloud.intensity[0], cloud.frame[0], cloud.line[0]) == (0.5, 7, 9)


@KINDS
def test_every_truncation_is_refused(tmp_path, name):
    write_cloud(tmp_path / name, some_cloud())
    whole, cut = (tmp_path / name).read_bytes(), tmp_path / f"cut-{name}"
    checked = 0
    for length in range(0, len(whole), 11):
        cut.write_bytes(whole[:length])
        with pytest.raises(CaptureError, match=cut.name):
            read_cloud(cut)
        checked += 1
    assert checked > 150


def with_metadata(comment: bytes) -> bytes:
    start = b"ply\nformat ascii 1.0\ncomment uwlts-metadata " + comment + b";\nelement vertex 0\n"
    return start + b"property float x\nproperty float y\nproperty float z\nend_header\n"


X, Y, Z = (("x", "f4"), ("y", "f4"), ("z", "f4"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x89PNG\r\n", "not a complete PLY"),
        (b"ply\nformat ascii 1.0\nend_header\n", "without vertices"),
        (with_metadata(b"1/2 {}"), "incomplete"),
        (with_metadata(b"1/1 {"), "damaged"),
        (np.array([(1, 2)], dtype=[X, Y]), "no z"),
        (np.array([([1, 2], 2, 3)], dtype=[("x", "f4", (2,)), Y, Z]), "x is a list"),
        (np.array([(1, np.nan, 3)], dtype=[X, Y, Z]), "1 of 1 points"),
        (np.array([(1, 2, 3, 0.5)], dtype=[X, Y, Z, ("frame", "f4")]), "no whole numbers"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path, content, message):
    path = tmp_path / "foreign.ply"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        write_by_hand(path, content)
    with pytest.raises(CaptureError, match=message) as refusal:
        read_cloud(path)
    assert "foreign.ply" in str(refusal.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for name in ("none.ply", "none.h5"):
        with pytest.raises(CaptureError, match="no cloud at"):
            read_cloud(tmp_path / name)
    with pytest.raises(CaptureError, match="cannot read"):
        read_cloud(tmp_path)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"points_mm": np.zeros((40, 2))}, r"\(N, 3\)"),
        ({"points_mm": np.full((40, 3), np.inf)}, "40 of 40"),
        ({"frame": np.zeros(39)}, "frame has the shape"),
        ({"deviation_mm": np.zeros((40, 1))}, "deviation_mm has the shape"),
        ({"metadata": {"bad": np.float32(1)}}, "JSON"),
        ({"metadata": {"bad": float("nan")}}, "JSON"),
        ({"metadata": {1: "keys are strings"}}, "dict of strings"),
    ],
)
def test_inconsistent_clouds_are_refused(changes, message):
    with pytest.raises(CaptureError, match=message):
        some_cloud(**changes)


def test_a_cloud_cannot_be_changed_through_its_arrays():
    cloud = some_cloud()
    with pytest.raises(ValueError, match="read-only"):
        cloud.points_mm[0] = 0


@KINDS
def test_existing_files_are_refused_unless_overwriting_is_asked_for(tmp_path, name):
    path = tmp_path / name
    write_cloud(path, some_cloud())
    with pytest.raises(OutputError, match="exists already"):
        write_cloud(path, some_cloud(3))
    assert len(read_cloud(path)) == 40
    write_cloud(path, some_cloud(3), overwrite=True)
    assert len(read_cloud(path)) == 3


@KINDS
def test_a_write_that_the_system_cuts_short_leaves_the_old_file(tmp_path, name):
    path = tmp_path / name
    write_cloud(path, some_cloud(3))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OutputError, match=f"cannot write .*{name}"):
            write_cloud(path, some_cloud(5000), overwrite=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(read_cloud(path)) == 3
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError, SystemExit])
def test_any_exception_removes_the_temporary_file(tmp_path, interruption):
    (tmp_path / "a.json").write_text("old")
    with pytest.raises(interruption), write_atomically(tmp_path / "a.json", overwrite=True) as aside:
        aside.write_text("half")
        raise interruption
    assert os.listdir(tmp_path) == ["a.json"]
    assert (tmp_path / "a.json").read_text() == "old"


@pytest.mark.parametrize(
    "number, message",
    [(errno.ENOSPC, "disk is full"), (errno.EACCES, "no permission"), (errno.EROFS, "read-only"), (errno.EIO, "error")],
)
def test_errors_of_the_system_say_what_to_do(tmp_path, number, message):
    with pytest.raises(OutputError, match=message), write_atomically(tmp_path / "a.json"):
        raise OSError(number, os.strerror(number))
    assert os.listdir(tmp_path) == []


def test_the_file_appears_at_the_end_with_its_suffix_and_ordinary_permissions(tmp_path):
    mask = os.umask(0o027)
    try:
        with write_atomically(tmp_path / "a.json") as aside:
            aside.write_text("{}")
            assert aside.parent == tmp_path and aside.suffix == ".json"
            assert not (tmp_path / "a.json").exists()
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").read_text() == "{}"
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o640


def test_a_file_that_appears_meanwhile_is_not_replaced(tmp_path):
    with pytest.raises(OutputError, match="exists already"), write_atomically(tmp_path / "a.json") as aside:
        aside.write_text("mine")
        (tmp_path / "a.json").write_text("theirs")
    assert (tmp_path / "a.json").read_text() == "theirs"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / "file.json").write_text("old")
    (tmp_path / "link.json").symlink_to("file.json")
    with write_atomically(tmp_path / "link.json", overwrite=True) as aside:
        aside.write_text("new")
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "file.json").read_text() == "new"


def test_unsuitable_places_are_refused_before_the_body_runs(tmp_path):
    (tmp_path / "folder.json").mkdir()
    for path, message in (
        (tmp_path / "missing" / "a.json", "create it first"),
        (tmp_path / "folder.json", "not a regular file"),
        (Path("/dev/null"), "not a regular file"),
    ):
        with pytest.raises(OutputError, match=message), write_atomically(path, overwrite=True):
            pytest.fail("the body ran")
    with pytest.raises(OutputError, match="cannot write"), write_atomically(Path("/proc/a.json")):
        pytest.fail("the body ran")
