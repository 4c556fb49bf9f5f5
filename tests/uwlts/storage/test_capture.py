"""The capture file: its content, the remains of killed or failing recordings, and messages about damaged files."""

import errno
import json
import random
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.uwlts.storage.drawn_captures import HEIGHT, WIDTH, a_frame, a_header, interrupted, record, small_sensor
from uwlts.errors import CaptureError, ImageError, OutputError
from uwlts.storage import capture_writer
from uwlts.storage.capture import Capture, CaptureHeader, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.hdf5_file import has_writer, read_label, write_label

ROOT = Path(__file__).resolve().parents[3]
BLOSC_FILTER, FLETCHER_FILTER = 32001, h5py.h5z.FILTER_FLETCHER32
SHAPE = 200, 240
"""Rows and columns of the images that other processes record."""


def assert_holds(capture: Capture, count: int, dtype=np.uint8) -> None:
    assert len(capture) == count
    for index in range(count):
        assert np.array_equal(capture.image(index), a_frame(index, dtype).image)
    assert capture.stage_mm.tolist() == [0.1 * index for index in range(count)]
    assert capture.time_s.tolist() == [7.0 * index for index in range(count)]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("with_pose", [False, True])
def test_everything_comes_back(tmp_path: Path, dtype: type, with_pose: bool):
    header, path = a_header(), tmp_path / "a.h5"
    with CaptureWriter(path, header, dtype=dtype) as writer:
        for index in range(5):
            writer.append(a_frame(index, dtype, pose=with_pose and index != 2))
            assert len(writer) == index + 1
    assert list(tmp_path.iterdir()) == [path]
    with Capture(path) as capture:
        assert capture.header == header
        assert capture.finished
        assert_holds(capture, 5, dtype)
        for index in range(5):
            written, found = a_frame(index, dtype, pose=with_pose and index != 2), capture[index]
            assert found.image.dtype == dtype
            assert np.array_equal(found.image, written.image)
            if written.pose is None:
                assert found.pose is None
                assert np.isnan(capture.pose[index]).all()
            else:
                assert np.array_equal(found.pose, written.pose)
            numbers = (found.stage_mm, found.laser_on, found.exposure_ms, found.time_s)
            assert numbers == (written.stage_mm, written.laser_on, written.exposure_ms, written.time_s)
        assert capture.laser_on.dtype == bool


def test_a_moving_stage_has_speeds_and_reports(tmp_path: Path):
    path, written = tmp_path / "m.h5", {"dtype": np.dtype(np.uint8), "moving": True}
    with pytest.raises(KeyboardInterrupt), CaptureWriter(path, a_header(), **written) as writer:
        writer.append(replace(a_frame(0), speed_mm_per_s=3.0))
        raise KeyboardInterrupt
    with pytest.raises(CaptureError, match="belongs to another recording"):
        CaptureWriter(path, a_header(), dtype=np.dtype(np.uint8), resume=True)
    with CaptureWriter(path, a_header(), **written, resume=True) as writer:
        writer.append(a_frame(1))
        writer.place(np.array([0.5, 0.75]), np.array([2.5, 2.5]), np.array([[0.0, 0.5], [0.1, 0.75], [0.2, 1.0]]))
    with Capture(path) as capture:
        assert capture.moving and capture.stage_reports.shape == (3, 2)
        assert capture.stage_mm.tolist() == [0.5, 0.75] and capture.speed_mm_per_s.tolist() == [2.5, 2.5]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_big_endian_numbers_become_those_of_the_machine(tmp_path: Path, dtype: type):
    """Compiled functions refuse arrays in another byte order."""
    record(tmp_path / "a.h5", 3, dtype)
    with h5py.File(tmp_path / "a.h5") as source, h5py.File(tmp_path / "b.h5", "w", libver="latest") as copy:
        for name in source.attrs:
            copy.attrs.create(name, source.attrs[name], dtype=source.attrs.get_id(name).dtype)
        for name, each in source.items():
            kind = each.dtype.newbyteorder(">")
            copy.create_dataset(name, data=each[...].astype(kind), chunks=each.chunks, maxshape=each.maxshape)
            assert copy[name].dtype.byteorder == ">" or kind.itemsize == 1
    with Capture(tmp_path / "a.h5") as expected, Capture(tmp_path / "b.h5") as found:
        assert found.dtype == dtype and found.pose.dtype.isnative and found.stage_mm.dtype.isnative
        assert np.array_equal(found.pose, expected.pose, equal_nan=True)
        for one, other in zip(found, expected, strict=True):
            assert one.image.dtype.isnative and np.array_equal(one.image, other.image) and one.time_s == other.time_s


def test_a_process_that_writes_no_capture_reads_one(tmp_path: Path):
    """A uniform image, which is stored compressed; noise is not."""
    path = tmp_path / "a.h5"
    image = np.full((200, 300), 7, np.uint8)
    with CaptureWriter(path, a_header(sensor=small_sensor(300, 200)), dtype=np.uint8) as writer:
        writer.append(Frame(image, 0.0, True, 1.0, 0.0))
    code = "import sys; from uwlts.storage.capture import Capture; print(Capture(sys.argv[1]).image(0).sum())"
    read = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, cwd=ROOT)
    assert read.returncode == 0, read.stderr
    assert int(read.stdout) == 7 * image.size


def test_frames_by_light(tmp_path: Path):
    with Capture(record(tmp_path / "a.h5", 5)) as capture:
        assert [index for index, _ in capture.frames()] == [0, 1, 2, 3, 4]
        assert [index for index, _ in capture.frames(laser_on=True)] == [1, 3]
        assert [index for index, _ in capture.frames(laser_on=False)] == [0, 2, 4]
        assert all(np.array_equal(image, a_frame(index).image) for index, image in capture.frames(laser_on=True))
        with pytest.raises(IndexError):
            capture.image(5)
        with pytest.raises(IndexError):
            capture.image(-1)


def test_structure_is_as_documented(tmp_path: Path):
    """Read with plain h5py only: names, shapes, chunks, filters, label; nothing is unpickled or linked."""
    path = record(tmp_path / "a.h5", 3, np.uint16)
    with h5py.File(path, "r") as file:
        assert set(file.attrs) == {"format", "version", "header"}
        assert (file.attrs["format"], int(file.attrs["version"])) == (b"uwlts-capture", 1)
        header = json.loads(file.attrs["header"])
        assert header["sensor"]["camera"]["width_px"] == WIDTH
        assert header["artefact"]["nested"] == {"serial": "µ-7"}
        shapes = {name: dataset.shape for name, dataset in file.items()}
        assert shapes == {
            "frames": (3, HEIGHT, WIDTH),
            "stage_mm": (3,),
            "pose": (3, 4, 4),
            "laser_on": (3,),
            "exposure_ms": (3,),
            "time_s": (3,),
        }
        assert file["frames"].dtype == np.uint16
        assert file["frames"].chunks == (1, HEIGHT, WIDTH)
        plist = file["frames"].id.get_create_plist()
        filters = [plist.get_filter(number)[0] for number in range(plist.get_nfilters())]
        assert filters == [BLOSC_FILTER, FLETCHER_FILTER]
        kinds = [dataset.dtype.kind for dataset in file.values()]
        kinds += [file.attrs.get_id(name).dtype.kind for name in file.attrs]
        assert set(kinds) <= set("fbuiS")


def test_header_of_any_length(tmp_path: Path):
    """HDF5 stores attributes beyond 64 KiB elsewhere."""
    notes = {"notes": ["ünusual " * 40] * 600}
    path = record(tmp_path / "a.h5", 1, header=a_header(provenance=notes))
    with Capture(path) as capture:
        assert capture.header.provenance == notes


def test_header_refuses_what_makes_no_sense():
    for changes in ({"stage_direction": (1.0, 1.0, 0.0)}, {"stage_direction": (0.0, 0.0, 0.0)}, {"saturation_dn": 0}):
        with pytest.raises(ValueError, match=next(iter(changes))):
            a_header(**changes)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"image": np.zeros((HEIGHT, WIDTH + 1), np.uint8)}, ImageError, "25"),
        ({"image": np.zeros((WIDTH, HEIGHT), np.uint8)}, ImageError, "24, 20"),
        ({"image": np.zeros((HEIGHT, WIDTH, 3), np.uint8)}, ImageError, "3"),
        ({"image": np.zeros((HEIGHT, WIDTH), np.uint16)}, ImageError, "uint16"),
        ({"image": np.zeros((HEIGHT, WIDTH))}, ImageError, "float64"),
        *(
            ({name: value}, CaptureError, "finite")
            for name in ("stage_mm", "exposure_ms", "time_s")
            for value in (np.nan, np.inf)
        ),
        *(({"pose": np.diag([1.0, 1.0, value, 1.0])}, CaptureError, "finite") for value in (np.nan, np.inf)),
        *(({"pose": pose}, CaptureError, "4, 4") for pose in (np.eye(3), np.zeros(4), np.float64(1.0))),
    ],
)
def test_frames_of_another_kind_are_refused(tmp_path: Path, changes: dict, error: type[Exception], words: str):
    with CaptureWriter(tmp_path / "a.h5", a_header(), dtype=np.uint8) as writer:
        with pytest.raises(error, match=words):
            writer.append(replace(a_frame(0), **changes))
        assert len(writer) == 0
        writer.append(a_frame(0))
    with Capture(tmp_path / "a.h5") as capture:
        assert_holds(capture, 1)


def test_image_type_of_a_capture_is_8_or_16_bit(tmp_path: Path):
    with pytest.raises(ImageError, match="float32"):
        CaptureWriter(tmp_path / "a.h5", a_header(), dtype=np.float32)
    assert list(tmp_path.iterdir()) == []


# --- existing files


def test_existing_file_is_only_replaced_on_demand(tmp_path: Path):
    path = record(tmp_path / "a.h5", 2)
    before = path.read_bytes()
    for options in ({}, {"resume": True}):
        with pytest.raises(OutputError, match="exists already"):
            CaptureWriter(path, a_header(), dtype=np.uint8, **options)
    with pytest.raises(KeyboardInterrupt), CaptureWriter(path, a_header(), dtype=np.uint8, overwrite=True):
        raise KeyboardInterrupt
    assert path.read_bytes() == before, "an interrupted overwriting keeps the old capture"
    record(path, 4, overwrite=True)
    with Capture(path) as capture:
        assert_holds(capture, 4)
    assert list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_hold_a_capture(tmp_path: Path):
    with pytest.raises(OutputError, match=r"folder .*missing.* does not exist"):
        CaptureWriter(tmp_path / "missing" / "a.h5", a_header(), dtype=np.uint8)
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="not a regular file"):
        CaptureWriter(tmp_path / "folder", a_header(), dtype=np.uint8, overwrite=True)
    with pytest.raises(OutputError, match="File name too long"):
        CaptureWriter(tmp_path / ("a" * 300), a_header(), dtype=np.uint8)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_left_over_part_needs_a_decision(tmp_path: Path):
    path = tmp_path / "a.h5"
    part = interrupted(path, 3)
    with pytest.raises(OutputError, match=r"`resume` .*`overwrite`"):
        CaptureWriter(path, a_header(), dtype=np.uint8)
    with Capture(part) as capture:
        assert not capture.finished
        assert_holds(capture, 3)
    with CaptureWriter(path, a_header(), dtype=np.uint8, overwrite=True) as writer:
        assert len(writer) == 0
    with Capture(path) as capture:
        assert len(capture) == 0
        assert list(capture.frames()) == []


def test_resuming_goes_on_where_it_stopped(tmp_path: Path):
    """Also with a header that JSON changes, which has lists instead of Python's tuples."""
    header, path = a_header(target={"corners": ((0.0, 1.0), (2.0, 3.0))}), tmp_path / "a.h5"
    interrupted(path, 3, header=header)
    with CaptureWriter(path, header, dtype=np.uint8, resume=True) as writer:
        assert len(writer) == 3
        writer.append(a_frame(3))
    with Capture(path) as capture:
        assert_holds(capture, 4)
    assert list(tmp_path.iterdir()) == [path]


def test_resuming_nothing_starts(tmp_path: Path):
    with Capture(record(tmp_path / "a.h5", 2, resume=True)) as capture:
        assert_holds(capture, 2)


def test_another_recording_is_told_by_its_entries(tmp_path: Path):
    path = tmp_path / "a.h5"
    part = interrupted(path, 1, plan={"stage": {"start_mm": 0.0, "count": 4}, "laser_ms": "auto"})
    before = part.read_bytes()
    for header, plan, says in (
        (a_header(provenance={"seed": 5}), {}, "header.provenance.seed is 4 in it, 5 now"),
        (a_header(), {"laser_ms": 2.0}, r'plan.laser_ms is "auto" in it, 2.0 now'),
        (a_header(), {"stage": {"start_mm": 0.0, "count": 9}}, "plan.stage.count is 4 in it, 9 now. Continue"),
        (a_header(stage_direction=(0.0, 0.6, 0.8)), {}, "header.stage_direction[0] is 0.6 in it, 0.0 now"),
        (a_header(), {"background": True}, "plan.background is not stated in it, true now"),
        (a_header(name="x"), {"a": 1, "b": 2, "c": 3}, "plan.c is not stated in it, 3 now; and 1 more"),
    ):
        table = {"stage": {"start_mm": 0.0, "count": 4}, "laser_ms": "auto"} | plan
        with pytest.raises(CaptureError, match=rf"another recording: .*{re.escape(says)}"):
            CaptureWriter(path, header, dtype=np.uint8, plan=table, resume=True)
    with pytest.raises(CaptureError, match="another recording"):
        CaptureWriter(path, a_header(), dtype=np.uint16, resume=True)
    assert part.read_bytes() == before
    part.write_bytes(b"something else")
    with pytest.raises(CaptureError, match=r"cannot resume: .*`overwrite`"):
        CaptureWriter(path, a_header(), dtype=np.uint8, resume=True)
    assert sorted(tmp_path.iterdir()) == [part]


def test_a_plan_is_kept_while_it_is_not_fulfilled(tmp_path: Path):
    path, plan = tmp_path / "a.h5", {"scene": {"secret": "ä" * 100_000}}
    part = interrupted(path, 1, plan=plan)
    with Capture(part) as unfinished:
        assert unfinished.plan() == plan
    with CaptureWriter(path, a_header(), dtype=np.uint8, plan=plan, resume=True) as writer:
        writer.append(a_frame(1))
    with Capture(path) as capture:
        assert capture.plan() is None
        assert_holds(capture, 2)
    assert b"secret" not in path.read_bytes()


def test_a_recording_without_a_frame_leaves_nothing(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), CaptureWriter(tmp_path / "a.h5", a_header(), dtype=np.uint8):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_two_recordings_at_a_time_are_refused(tmp_path: Path):
    """Otherwise the second writer would mistake the part of the first for an interrupted one."""
    path = tmp_path / "a.h5"
    with CaptureWriter(path, a_header(), dtype=np.uint8) as writer:
        writer.append(a_frame(0))
        code = (
            "import sys, numpy as np\n"
            "from tests.uwlts.storage.drawn_captures import *\n"
            "for how in ({'resume': True}, {'overwrite': True}, {}):\n"
            "    try: CaptureWriter(sys.argv[1], a_header(), dtype=np.uint8, **how)\n"
            "    except Exception as error: print(error)"
        )
        second = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, cwd=ROOT)
        assert second.stdout.count("another process is writing") == 3, second.stderr
        writer.append(a_frame(1))
    with Capture(path) as capture:
        assert_holds(capture, 2)
    assert list(tmp_path.iterdir()) == [path]


# --- recordings that are killed, followed, or run out of space

_CHILD = """
import sys
import numpy as np
from tests.uwlts.storage.drawn_captures import *

path, count = Path(sys.argv[1]), int(sys.argv[2])
header = a_header(sensor=small_sensor(240, 200))
with CaptureWriter(path, header, dtype=np.uint8, resume="resume" in sys.argv) as writer:
    for index in range(len(writer), count):
        writer.append(a_frame(index, shape=(200, 240)))
        print(index, flush=True)
"""


def child(*arguments: object, before: str = "", **options) -> subprocess.Popen:
    command = [sys.executable, "-c", before + _CHILD, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def announced(process: subprocess.Popen) -> list[int]:
    return [int(line) for line in process.stdout.read().split()]


def test_killed_recording_keeps_every_announced_frame_and_can_be_resumed(tmp_path: Path):
    path, rng = tmp_path / "a.h5", random.Random(1)
    done = 0
    for _ in range(3):
        process = child(path, 100000, "resume")
        first = process.stdout.readline()
        assert first, process.stderr.read()
        time.sleep(rng.uniform(0, 0.1))
        process.kill()
        seen = [int(first), *announced(process)]
        assert process.wait() == -signal.SIGKILL
        assert seen == list(range(done, done + len(seen))), "a resumed run continues with the next frame"
        process.stdout.close()
        process.stderr.close()
        assert has_writer(part_path(path))
        with Capture(part_path(path)) as capture:
            # The frame announced when the signal came may be complete.
            assert len(capture) in (seen[-1] + 1, seen[-1] + 2)
            for index, image in capture.frames():
                assert np.array_equal(image, a_frame(index, shape=SHAPE).image)
            done = len(capture)
    assert done >= 3
    header = a_header(sensor=small_sensor(240, 200))
    with CaptureWriter(path, header, dtype=np.uint8, resume=True) as writer:
        writer.append(a_frame(done, shape=SHAPE))
    with Capture(path) as capture:
        assert len(capture) == done + 1
        assert all(np.array_equal(image, a_frame(index, shape=SHAPE).image) for index, image in capture.frames())
    assert list(tmp_path.iterdir()) == [path]


def test_running_recording_can_be_followed(tmp_path: Path):
    path = tmp_path / "a.h5"
    process = child(path, 40)
    assert process.stdout.readline() == "0\n"
    lengths = [0]
    while process.poll() is None:
        try:
            capture = Capture(part_path(path))
        except CaptureError:
            assert path.exists(), "it is renamed once it is whole"
            break
        with capture:
            lengths.append(len(capture))
            for index in range(max(0, len(capture) - 2), len(capture)):
                assert np.array_equal(capture.image(index), a_frame(index, shape=SHAPE).image)
    errors = process.communicate()[1]
    assert (process.returncode, errors) == (0, "")
    assert lengths == sorted(lengths)
    assert len(set(lengths)) > 3, "the reader saw the recording grow"
    with Capture(path) as capture:
        assert len(capture) == 40


def test_the_process_that_records_reads_its_part(tmp_path: Path):
    path = tmp_path / "a.h5"
    with CaptureWriter(path, a_header(), dtype=np.uint8) as writer:
        for index in range(4):
            writer.append(a_frame(index))
            with Capture(part_path(path)) as capture:
                assert_holds(capture, index + 1)
    with Capture(path) as capture:
        assert_holds(capture, 4)


def test_finished_capture_has_many_readers(tmp_path: Path):
    path = record(tmp_path / "a.h5", 3)
    path.chmod(0o444)
    with h5py.File(path, "r") as plain, Capture(path) as one, Capture(path) as other:
        assert_holds(one, 3)
        assert_holds(other, 3)
        assert plain["frames"].shape[0] == 3
    # The recording may be replaced during reading; the reader keeps the file that it opened.
    with Capture(path) as old:
        record(path, 1, overwrite=True)
        assert_holds(old, 3)


def test_storage_that_ends_stops_the_recording_and_keeps_its_frames(tmp_path: Path):
    """A file size limit simulates a full disk: the same system calls fail at the same places."""
    path, limit = tmp_path / "a.h5", 2**21
    before = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
    process = child(path, 1000, before=before)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 1, "HDF5 must not crash the process"
    assert errors.strip().splitlines()[-1].startswith("uwlts.errors.OutputError: cannot write")
    assert "File too large; complete frames are kept in a.h5.part" in errors
    frames = [int(line) for line in output.split()]
    assert len(frames) > 10
    with Capture(part_path(path)) as capture:
        assert len(capture) == len(frames)
        assert all(np.array_equal(image, a_frame(index, shape=SHAPE).image) for index, image in capture.frames())
    # With free space again, the same command continues.
    process = child(path, len(frames) + 2, "resume")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output.split()) == (0, [str(len(frames)), str(len(frames) + 1)])


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "x"), OSError("Can't write data"), RuntimeError("Unable to\nflush (errno = 28)")]
)
@pytest.mark.parametrize("name", ["frames", "stage_mm", "pose", "laser_on", "exposure_ms", "time_s"])
def test_failing_write_leaves_the_frames_before(tmp_path: Path, monkeypatch, name: str, error: Exception):
    path, flush = tmp_path / "a.h5", h5py.Dataset.flush

    def failing(dataset: h5py.Dataset) -> None:
        if dataset.name == f"/{name}" and dataset.shape[0] == 3:
            raise error
        flush(dataset)

    monkeypatch.setattr(h5py.Dataset, "flush", failing)
    with pytest.raises(OutputError, match=r"a\.h5.*kept in a\.h5\.part") as caught:
        record(path, 5)
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is error
    monkeypatch.undo()
    with Capture(part_path(path)) as capture:
        # A failure after the last array is stored loses nothing.
        count = 3 if name == "time_s" else 2
        assert_holds(capture, count)
    with Capture(record(path, 5, resume=True)) as capture:
        assert_holds(capture, 5)


def test_failing_close_keeps_the_part(tmp_path: Path, monkeypatch):
    def failing(path: Path) -> None:
        raise RuntimeError("Can't decrement id ref count")

    monkeypatch.setattr(capture_writer, "truncate", failing)
    path = tmp_path / "a.h5"
    with pytest.raises(OutputError, match="ref count"):
        record(path, 2)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    writer = CaptureWriter(path, a_header(), dtype=np.uint8)
    monkeypatch.setattr(capture_writer, "truncate", failing)
    with pytest.raises(OutputError, match=r"ref count; complete frames are kept in a\.h5\.part"), writer:
        writer.append(a_frame(0))
    with Capture(part_path(path)) as capture:
        assert_holds(capture, 1)


# --- foreign and damaged files


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return record(tmp_path_factory.mktemp("valid") / "a.h5", 4).read_bytes()


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Bytes of the part of a killed recording."""
    path = tmp_path_factory.mktemp("killed") / "a.h5"
    code = (
        "import os\nfrom tests.uwlts.storage.drawn_captures import *\n"
        f"writer = CaptureWriter({str(path)!r}, a_header(), dtype=np.uint8)\n"
        "[writer.append(a_frame(index)) for index in range(4)]\nos.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert has_writer(part_path(path))
    return part_path(path).read_bytes()


def read_all(path: Path) -> None:
    with Capture(path) as capture:
        for index in range(len(capture)):
            capture[index]


def refused(path: Path, words: str) -> None:
    with pytest.raises(CaptureError, match=words) as caught:
        read_all(path)
    assert str(path) in str(caught.value)


def test_things_that_are_no_captures(tmp_path: Path, valid: bytes):
    refused(tmp_path / "missing.h5", "no capture at")
    (tmp_path / "folder.h5").mkdir()
    refused(tmp_path / "folder.h5", "is a directory")
    for name, content in (("text.h5", b"stage_mm;image\n" * 100), ("empty.h5", b""), ("half-signature.h5", valid[:5])):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, "not a capture, or is truncated")
    foreign = tmp_path / "foreign.h5"
    with h5py.File(foreign, "w") as file:
        file["frames"] = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    refused(foreign, "HDF5, but .*no format.*'uwlts-capture'")
    with h5py.File(foreign, "w") as file:
        write_label(file, file_format="uwlts-truth", version=1, header=a_header())
    refused(foreign, "format is 'uwlts-truth', expected 'uwlts-capture'")


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1, 0.3, 0.6, 0.9, 0.999])
def test_truncated_capture(tmp_path: Path, valid: bytes, killed: bytes, share: float):
    path = tmp_path / "a.h5"
    path.write_bytes(valid[: int(share * len(valid))])
    refused(path, "truncated")
    # The part ends with space claimed for the next frame; it is cut inside the used space.
    part, used = tmp_path / "a.h5.part", len(killed.rstrip(b"\0"))
    part.write_bytes(killed[: int(share * used)])
    refused(part, "truncated|damaged")


def changed(path: Path, valid: bytes, change) -> Path:
    path.write_bytes(valid)
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def replaced(name: str, values: np.ndarray, **options):
    def change(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, data=values, **options)

    return change


def with_header(edit):
    def change(file: h5py.File) -> None:
        header = json.loads(file.attrs["header"])
        edit(header)
        file.attrs["header"] = np.bytes_(json.dumps(header).encode())

    return change


def set_attribute(name: str, value):
    return lambda file: file.attrs.__setitem__(name, value)


def never_stored(file: h5py.File) -> None:
    for dataset in file.values():
        dataset.resize(7, axis=0)


CONTRADICTIONS = {
    # Such text is outside HDF5's checksums, so that a reader that follows it may never return.
    "label of variable length": (set_attribute("format", "uwlts-capture"), "no format"),
    "newer": (set_attribute("version", 3), "version 3; .*reads up to 2"),
    "version is text": (set_attribute("version", "1"), "version is no number"),
    "version is a list": (set_attribute("version", [1, 2]), "version is"),
    "no version": (lambda file: file.attrs.__delitem__("version"), "version is no number"),
    "no header": (lambda file: file.attrs.__delitem__("header"), "header is missing"),
    "header of numbers": (set_attribute("header", [1, 2]), "header is missing"),
    "header is no JSON": (set_attribute("header", np.bytes_(b"{'a': 1}")), "not JSON"),
    "header is no object": (set_attribute("header", np.bytes_(b"[1, 2]")), "not a valid capture header"),
    "header is nested deeply": (set_attribute("header", np.bytes_(b"[" * 50000)), "damaged"),
    "header is no UTF-8": (set_attribute("header", np.bytes_(b"\xff\xfe{}")), "damaged"),
    "unknown key": (with_header(lambda header: header.update(colour="red")), "colour: unknown key"),
    "unknown glass": (
        with_header(lambda header: header["sensor"]["camera"]["window"].update(glass="unobtainium")),
        "unobtainium",
    ),
    "another image size": (
        with_header(lambda header: header["sensor"]["camera"].update(width_px=WIDTH + 1)),
        r"'frames' is uint8 of \(20, 24\)",
    ),
    "no stage direction": (with_header(lambda header: header.update(stage_direction=[0, 0, 0])), "unit vector"),
    "missing frames": (lambda file: file.__delitem__("frames"), "no 'frames'"),
    "missing stage_mm": (lambda file: file.__delitem__("stage_mm"), "no 'stage_mm'"),
    "group for an array": (lambda file: (file.__delitem__("time_s"), file.create_group("time_s")), "no 'time_s'"),
    "scalar": (replaced("time_s", np.float64(1.0)), "no 'time_s'"),
    "text": (replaced("exposure_ms", np.array([b"1 ms"] * 4)), "'exposure_ms'"),
    "real images": (replaced("frames", np.zeros((4, HEIGHT, WIDTH)), chunks=(1, HEIGHT, WIDTH)), "'frames' is float64"),
    "wide images": (replaced("frames", np.zeros((4, HEIGHT, WIDTH), np.uint32), chunks=(1, HEIGHT, WIDTH)), "uint32"),
    "one chunk": (replaced("frames", np.zeros((4, HEIGHT, WIDTH), np.uint8), chunks=(4, HEIGHT, WIDTH)), "chunks"),
    "no chunks": (replaced("frames", np.zeros((4, HEIGHT, WIDTH), np.uint8)), "chunks of None"),
    "poses of 3 x 3": (replaced("pose", np.zeros((4, 3, 3))), "'pose'"),
    "half a pose": (lambda file: file["pose"].__setitem__((2, 0), 1.0), "only some of their elements"),
    "stage nowhere": (lambda file: file["stage_mm"].__setitem__(1, np.nan), "not finite"),
    "endless exposure": (lambda file: file["exposure_ms"].__setitem__(1, np.inf), "not finite"),
    "no time": (lambda file: file["time_s"].__setitem__(1, np.nan), "not finite"),
    "images never stored": (never_stored, "holds 4 of 7 images"),
    "centre lines of a 3D camera": (
        lambda file: file.create_dataset("centre_lines", data=np.zeros((4, 4, WIDTH))),
        "centre lines of a 3D camera, expected images only: read it with uwlts 0.2",
    ),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradictions(tmp_path: Path, valid: bytes, case: str):
    change, words = CONTRADICTIONS[case]
    refused(changed(tmp_path / "a.h5", valid, change), words)


def test_shortest_array_counts(tmp_path: Path, valid: bytes):
    """A recording killed between two arrays has one more row in the first."""
    path = changed(tmp_path / "a.h5", valid, lambda file: file["time_s"].resize(3, axis=0))
    with Capture(path) as capture:
        assert_holds(capture, 3)


def test_damaged_image_is_noticed_and_the_others_are_fine(tmp_path: Path, valid: bytes):
    path = tmp_path / "a.h5"
    path.write_bytes(valid)
    with h5py.File(path, "r") as file:
        chunk = file["frames"].id.get_chunk_info_by_coord((2, 0, 0))
    noticed = 0
    # All bytes but the checksum's own belong to the compressed image; every eighth one suffices.
    for place in range(0, chunk.size, 8):
        damaged = bytearray(valid)
        damaged[chunk.byte_offset + place] ^= 0x10
        path.write_bytes(damaged)
        with Capture(path) as capture:
            with pytest.raises(CaptureError, match=r"frame 2 of .*a\.h5 cannot be read"):
                capture.image(2)
            noticed += 1
            for index in (0, 1, 3):
                assert np.array_equal(capture.image(index), a_frame(index).image)
    assert noticed > 40


def test_resuming_never_carries_a_damaged_image_over(tmp_path: Path):
    path = tmp_path / "a.h5"
    part = interrupted(path, 3)
    with h5py.File(part, "r") as file:
        chunk = file["frames"].id.get_chunk_info_by_coord((1, 0, 0))
    damaged = bytearray(part.read_bytes())
    damaged[chunk.byte_offset + 30] ^= 0xFF
    part.write_bytes(damaged)
    with pytest.raises(CaptureError, match="frame 1 of"):
        CaptureWriter(path, a_header(), dtype=np.uint8, resume=True)
    assert part.read_bytes() == bytes(damaged)
    assert list(tmp_path.iterdir()) == [part]


# --- internal functions


def test_label_is_read_without_the_rest(tmp_path: Path, valid: bytes):
    path = tmp_path / "a.h5"
    path.write_bytes(valid)
    with h5py.File(path, "r") as file:
        assert read_label(file, CaptureHeader, path=path, file_format="uwlts-capture", version=1) == a_header()
