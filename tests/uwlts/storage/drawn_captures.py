"""Small captures whose frames are recognised by their index; also for processes that record and are killed."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import CaptureHeader, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter

HEIGHT, WIDTH = 20, 24


def small_sensor(width: int = WIDTH, height: int = HEIGHT) -> Sensor:
    thesis = load_sensor("thesis")
    camera = thesis.camera.model_copy(update={"width_px": width, "height_px": height})
    return thesis.model_copy(update={"camera": camera})


def a_header(**changes) -> CaptureHeader:
    sensor = changes.pop("sensor", None) or small_sensor()
    known = {
        "name": "wäsche",
        "sensor": sensor,
        "medium_name": "water",
        "medium": sensor.media["water"],
        "stage_direction": (0.6, 0.0, 0.8),
        "saturation_dn": 255,
        "target": {"kind": "lattice", "pitch_mm": 9.375},
        "artefact": {"kind": "sphere", "radii": [1.5, 2.0], "nested": {"serial": "µ-7"}},
        "provenance": {"seed": 4},
    }
    return CaptureHeader(**(known | changes))


def a_frame(index: int, dtype=np.uint8, *, shape=(HEIGHT, WIDTH), pose: bool = False) -> Frame:
    """Every frame can be recognised by its index."""
    top = np.iinfo(dtype).max
    image = np.random.default_rng(index).integers(0, top, shape, dtype=dtype, endpoint=True)
    matrix = np.eye(4)
    matrix[:3, 3] = index, -index, 0.5
    return Frame(image, 0.1 * index, index % 2 == 1, 2.5 + index, 7.0 * index, matrix if pose else None)


def record(path: Path, count: int, dtype=np.uint8, *, header: CaptureHeader | None = None, **options) -> Path:
    with CaptureWriter(path, header or a_header(), dtype=dtype, **options) as writer:
        for index in range(len(writer), count):
            writer.append(a_frame(index, dtype))
    return path


def interrupted(path: Path, count: int, *, header: CaptureHeader | None = None, plan: dict | None = None) -> Path:
    """A recording ended by an exception."""
    with suppress(KeyboardInterrupt), CaptureWriter(path, header or a_header(), dtype=np.uint8, plan=plan) as writer:
        for index in range(count):
            writer.append(a_frame(index))
        raise KeyboardInterrupt
    return part_path(path)
