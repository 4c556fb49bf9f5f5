"""Whether a calibration fits a recording: image size, stripe, wavelength, lens, medium and window."""

from uwlts.errors import CalibrationError
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.model.sensor import CaptureHeader

_LARGEST_INDEX_CHANGE = 1e-3
"""Of the medium's index, as from 20 to 30 degC: polynomials, which hold the refraction they were made with, are then
wrong by 0.2 mm at 300 mm."""
_LARGEST_CHANGE_NM = 5.0
"""Of the laser's wavelength: lasers of one kind differ by less."""
_OTHER_LENS = 1.1
"""Ratio of two focal lengths: lenses of one kind differ by less."""


def check_fits(header: CaptureHeader, calibration: AnyCalibration, *, source: str) -> list[str]:
    """Refuse a calibration that cannot belong to a recording, by its header, and say what speaks against it otherwise.

    ``source`` is the recording's name for messages.

    Raises CalibrationError: image size, stripe orientation, wavelength or camera differ; the recording was made in
    water and the calibration has no window; or the calibration is one by polynomials and the recording was made in
    another medium, or with the window on in one and off in the other.
    """
    camera = header.sensor.camera
    model = calibration if isinstance(calibration, PolynomialCalibration) else calibration.camera
    size, wanted = (camera.width_px, camera.height_px), (model.width_px, model.height_px)
    if size != wanted:
        advice = "calibrate with images of this size, or use the calibration of the camera that took these"
        if size[::-1] == wanted:
            advice = "the images are turned by a quarter turn, turn them back"
        raise CalibrationError(
            f"{source} has images of {size[0]} x {size[1]} pixels, the calibration is for {wanted[0]} x {wanted[1]}: "
            f"{advice}"
        )
    if camera.stripe_along != calibration.stripe_along:
        raise CalibrationError(
            f"in {source} the stripe runs along the image's {camera.stripe_along}, in the calibration along "
            f"its {calibration.stripe_along}"
        )
    if abs(header.sensor.laser.wavelength_nm - calibration.wavelength_nm) > _LARGEST_CHANGE_NM:
        raise CalibrationError(
            f"{source} was taken with a laser of {header.sensor.laser.wavelength_nm:g} nm, the calibration is for "
            f"{calibration.wavelength_nm:g} nm: it is of another sensor"
        )
    other = header.sensor.name != calibration.sensor_name
    named = f"{source} is by the sensor '{header.sensor.name}', the calibration of '{calibration.sensor_name}'"
    if other and isinstance(calibration, Calibration):
        described, found = camera.focal_length_px(), calibration.camera.fx_px
        # Refraction that is left to the focal length makes it a third longer.
        if not 1 / _OTHER_LENS < found / described < 1.33 * _OTHER_LENS:
            raise CalibrationError(
                f"{named}, and by its description it has a focal length of {described:.0f} px, by the calibration "
                f"one of {found:.0f} px: calibrate this sensor"
            )
    if isinstance(calibration, PolynomialCalibration):
        _check_same_refraction(header, calibration, source=source)
    elif header.medium.kind not in ("air", calibration.medium_kind) and calibration.window is None:
        raise CalibrationError(
            f"{source} was made in {header.medium_name}, but the calibration is for "
            f"{calibration.medium_kind} only: calibrate again with step images taken in the medium (`step`)"
        )
    elif header.medium.kind == "air" and calibration.medium_kind != "air" and calibration.window is None:
        raise CalibrationError(
            f"{source} was made in air, but the calibration is that of a single viewpoint in water "
            f"({calibration.medium_kind}): its camera holds the refraction; calibrate in air"
        )
    return [f"{named}: is it the right one?"] if other else []


def _check_same_refraction(header: CaptureHeader, calibration: PolynomialCalibration, *, source: str) -> None:
    own = calibration.medium
    index, own_index = calibration.index_of(header.medium), calibration.index_of(own)
    if header.medium.kind != own.kind or abs(index - own_index) > _LARGEST_INDEX_CHANGE:
        raise CalibrationError(
            f"{source} was made in {header.medium_name} ({header.medium.kind}, n {index:.4f}), the "
            f"polynomials in {calibration.medium_name} ({own.kind}, n {own_index:.4f}): they hold in the medium they "
            "were made in only; calibrate again in this one"
        )
    if header.sensor.camera.window.mounted != calibration.window_mounted:
        here, there = ("without", "with") if calibration.window_mounted else ("with", "without")
        there = f"{there} the camera's window: calibrate again"
        raise CalibrationError(f"{source} was made {here} the camera's window, the polynomials {there}")
