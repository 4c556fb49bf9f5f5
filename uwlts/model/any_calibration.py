"""Calibrations of any kind, and the digest by which a cloud names its own."""

import hashlib
import weakref

from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration

AnyCalibration = Calibration | PolynomialCalibration


def calibration_digest(calibration: AnyCalibration) -> str:
    """Short digest that identifies a calibration, as the clouds made with it name it."""
    if (digest := _digests.get(id(calibration))) is None:
        digest = hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()[:16]
        _digests[id(calibration)] = digest
        weakref.finalize(calibration, _digests.pop, id(calibration), None).atexit = False
    return digest


_digests: dict[int, str] = {}
"""Digests of calibrations in use, by their identity."""
