"""Union of the kinds of calibration, and their digest, which identifies the calibration of a cloud."""

import hashlib
import weakref

from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration

AnyCalibration = Calibration | PolynomialCalibration


def calibration_digest(calibration: AnyCalibration) -> str:
    """Return the short digest that identifies a calibration in clouds."""
    if (digest := _digests.get(id(calibration))) is None:
        digest = hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()[:16]
        _digests[id(calibration)] = digest
        weakref.finalize(calibration, _digests.pop, id(calibration), None).atexit = False
    return digest


_digests: dict[int, str] = {}  # digests of calibrations in use, by `id`
