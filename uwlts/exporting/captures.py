"""A capture as a folder of images with a table of positions, which `uwlts import` reads back."""

import csv
import os
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import tomli_w

from uwlts.capture import Capture, Frame
from uwlts.errors import OutputError
from uwlts.importing.description import NAME
from uwlts.importing.matching import POSE_COLUMNS

HEADER, TABLE = "header.json", "frames.csv"


def export_capture(
    capture: Capture,
    folder: Path,
    *,
    image_format: Literal["png", "tiff"] = "png",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a capture's frames as images of its own depth, without loss, into a new folder; whole or not at all.

    Beside them stand frames.csv (file, light, stage_mm, exposure_ms, time_s, and the pose's elements if any frame has
    one), header.json and import.toml.

    Raises
    ------
    OutputError
        The folder exists, its parent is missing, or storage fails.
    CaptureError
        A frame's data are damaged.
    """
    if folder.exists():
        raise OutputError(f"{folder} exists already; give the name of a new folder")
    if not folder.parent.is_dir():
        raise OutputError(f"cannot make {folder}: the folder {folder.parent} does not exist; create it first")
    aside = folder.parent / f".{secrets.token_hex(8)}"
    try:
        aside.mkdir()
        rows = []
        for index in range(len(capture)):
            frame = capture.frame(index)
            name = f"{index:05d}-{_light(frame)}.{image_format}"
            _, encoded = cv2.imencode(f".{image_format}", frame.image)
            (aside / name).write_bytes(encoded.tobytes())
            rows.append(_row(name, frame))
            progress(index + 1, len(capture))
        with open(aside / TABLE, "w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, _columns(rows), restval="", lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
        (aside / HEADER).write_text(capture.header.model_dump_json(indent=2) + "\n", encoding="utf-8")
        told = {"header": HEADER, "table": TABLE, "repeated": True}
        (aside / NAME).write_text(tomli_w.dumps(told), encoding="utf-8")
        os.rename(aside, folder)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _light(frame: Frame) -> str:
    return "laser" if frame.laser_on else "lamp"


def _row(name: str, frame: Frame) -> dict[str, str | float]:
    row = {
        "file": name, "light": _light(frame), "stage_mm": frame.stage_mm, "exposure_ms": frame.exposure_ms,
        "time_s": frame.time_s,
    }  # fmt: skip
    return row if frame.pose is None else row | dict(zip(POSE_COLUMNS, frame.pose.ravel().tolist(), strict=True))


def _columns(rows: list[dict[str, str | float]]) -> list[str]:
    posed = any(POSE_COLUMNS[0] in row for row in rows)
    return ["file", "light", "stage_mm", "exposure_ms", "time_s", *(POSE_COLUMNS if posed else ())]
