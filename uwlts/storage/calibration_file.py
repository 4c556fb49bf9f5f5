"""Files of calibrations: JSON, written completely or not at all, and validated when read."""

from pathlib import Path

from uwlts.files.json_files import read_json, read_model
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import FORMAT, VERSION, Calibration
from uwlts.model.polynomial_calibration import (
    FORMAT as POLYNOMIALS_FORMAT,
    VERSION as POLYNOMIALS_VERSION,
    PolynomialCalibration,
)


def read_calibration(path: str | Path) -> Calibration:
    """Read a calibration; raises CaptureError if the file is missing, foreign, newer or damaged."""
    return read_model(path, Calibration, file_format=FORMAT, version=VERSION, called="calibration")


def load_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration of any kind; raises CaptureError if the file is missing, foreign, newer or damaged."""
    if read_json(path, called="calibration", check_seal=False).get("format") != POLYNOMIALS_FORMAT:
        return read_calibration(path)
    known = {"file_format": POLYNOMIALS_FORMAT, "version": POLYNOMIALS_VERSION, "called": "polynomial calibration"}
    return read_model(path, PolynomialCalibration, **known)


def resolve_calibration(calibration: AnyCalibration | str | Path) -> AnyCalibration:
    """Return a calibration unchanged, or read it from a file; raises the errors of `load_calibration`."""
    return load_calibration(calibration) if isinstance(calibration, str | Path) else calibration
