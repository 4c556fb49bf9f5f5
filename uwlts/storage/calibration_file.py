"""Files of calibrations: JSON, written whole or not at all, and checked when they are read."""

import json
from pathlib import Path
from typing import TypedDict, assert_never

from uwlts.files.json_files import model_in, read_json, read_model, write_model
from uwlts.files.writing import written_aside
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration

FORMAT, POLYNOMIALS_FORMAT, VERSION = "uwlts-calibration", "uwlts-polynomials", 1


class _Known(TypedDict):
    """By what a file of calibrations is recognised."""

    format: str
    version: int
    called: str


_CALIBRATION: _Known = {"format": FORMAT, "version": VERSION, "called": "calibration"}
_POLYNOMIALS: _Known = {"format": POLYNOMIALS_FORMAT, "version": VERSION, "called": "polynomial calibration"}


def write_calibration(path: str | Path, calibration: AnyCalibration, *, overwrite: bool = False) -> None:
    """Write a calibration of any kind as JSON, completely or not at all; OutputError if that fails."""
    match calibration:
        case Calibration():
            write_model(path, calibration, format=FORMAT, version=VERSION, overwrite=overwrite)
        case PolynomialCalibration():
            # One key a line: indented, the thousands of coefficients would take a line each.
            content = {"format": POLYNOMIALS_FORMAT, "version": VERSION} | calibration.model_dump(mode="json")
            lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
            with written_aside(path, overwrite=overwrite) as aside:
                aside.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")
        case _:
            assert_never(calibration)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration; CaptureError where the file is missing, foreign, newer or damaged."""
    return read_model(path, Calibration, **_CALIBRATION)


def read_polynomials(path: str | Path) -> PolynomialCalibration:
    """Read a polynomial calibration; CaptureError where the file is missing, foreign, newer or damaged."""
    return read_model(path, PolynomialCalibration, **_POLYNOMIALS)


def load_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration of any kind; CaptureError if the file is missing, foreign, newer or damaged."""
    content = read_json(path, called="calibration")
    if content.get("format") == POLYNOMIALS_FORMAT:
        return model_in(content, path, PolynomialCalibration, **_POLYNOMIALS)
    return model_in(content, path, Calibration, **_CALIBRATION)


def loaded_calibration(calibration: AnyCalibration | str | Path) -> AnyCalibration:
    """The calibration itself, or the one in a file; CaptureError as from `load_calibration`."""
    return load_calibration(calibration) if isinstance(calibration, str | Path) else calibration
