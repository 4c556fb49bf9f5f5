"""Files of calibrations: JSON, written whole or not at all, and checked when they are read."""

import json
from pathlib import Path

from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.storage.files import described, read_json, written_aside

FORMAT = "uwlts-calibration"


VERSION = 1


def write_calibration(path: str | Path, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Write a calibration as indented JSON, whole or not at all; OutputError where that fails."""
    content = {"format": FORMAT, "version": VERSION} | calibration.model_dump(mode="json")
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration; CaptureError where the file is missing, foreign, newer or damaged."""
    return described(
        read_json(path, called="calibration"),
        Calibration,
        path=path,
        format=FORMAT,
        version=VERSION,
        called="calibration",
        foreign="not a calibration",
    )


POLYNOMIALS_FORMAT = "uwlts-polynomials"


POLYNOMIALS_VERSION = 1


def write_polynomials(path: str | Path, calibration: PolynomialCalibration, *, overwrite: bool = False) -> None:
    """Write a polynomial calibration as JSON, one key a line, whole or not at all; OutputError where that fails."""
    content = {"format": POLYNOMIALS_FORMAT, "version": POLYNOMIALS_VERSION} | calibration.model_dump(mode="json")
    lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def read_polynomials(path: str | Path) -> PolynomialCalibration:
    """Read a polynomial calibration; CaptureError where the file is missing, foreign, newer or damaged."""
    return described(
        read_json(path, called="calibration"),
        PolynomialCalibration,
        path=path,
        format=POLYNOMIALS_FORMAT,
        version=POLYNOMIALS_VERSION,
        called="polynomial calibration",
        foreign="no polynomial calibration",
    )


def read_any_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration of either kind, by its "format"; CaptureError as from `read_calibration`."""
    kind = read_json(path, called="calibration").get("format")
    return read_polynomials(path) if kind == POLYNOMIALS_FORMAT else read_calibration(path)


def loaded_calibration(calibration: AnyCalibration | str | Path) -> AnyCalibration:
    """The calibration itself, or the one in a file; CaptureError as from `read_any_calibration`."""
    return read_any_calibration(calibration) if isinstance(calibration, str | Path) else calibration
