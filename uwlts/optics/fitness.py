"""Check of a calibration against a recording: image size and place, stripe, wavelength, lens, medium and window."""

from uwlts.errors import CalibrationError
from uwlts.model.calibration import AnyCalibration, Calibration, PolynomialCalibration
from uwlts.model.joint_estimate import Origin
from uwlts.model.sensor import Camera, CaptureHeader

_LARGEST_INDEX_CHANGE = 1e-3
"""Limit for the medium's index, about the change from 20 to 30 degC. Polynomials contain the refraction of their own
calibration, so that the change causes an error of 0.2 mm at 300 mm."""
_LARGEST_CHANGE_NM = 5.0  # limit for the laser's wavelength: lasers of the same type differ by less
_OTHER_LENS = 1.1  # limit for the ratio of two focal lengths: lenses of the same type differ by less


def _check_images(camera: Camera, calibration: AnyCalibration, *, source: str) -> None:
    """Raise CalibrationError if size, offset or orientation of images differ."""
    model = calibration if isinstance(calibration, PolynomialCalibration) else calibration.camera
    size, wanted = (camera.width_px, camera.height_px), (model.width_px, model.height_px)
    if size != wanted:
        advice = "calibrate with images of this size, or use the calibration of the camera that took these"
        if size[::-1] == wanted:
            advice = "rotate the images by 90 deg"
        raise CalibrationError(
            f"{source} has images of {size[0]} x {size[1]} pixels, the calibration is for {wanted[0]} x {wanted[1]}: "
            f"{advice}"
        )
    offsets = _list_offsets(calibration)
    if camera.offset_px is not None and offsets - {camera.offset_px}:
        raise CalibrationError(
            f"{source} has images from {camera.offset_px} px of the image sensor, the calibration is for images from "
            f"{', '.join(map(str, sorted(offsets)))} px: calibrate with images of this region (`offset_px`)"
        )
    if camera.stripe_along != calibration.stripe_along:
        raise CalibrationError(
            f"in {source} the stripe runs along the image's {camera.stripe_along}, in the calibration along "
            f"its {calibration.stripe_along}"
        )


def check_fits(header: CaptureHeader, calibration: AnyCalibration, *, source: str) -> list[str]:
    """Compare the header of a recording, named ``source``, with a calibration, and return warnings about differences.

    Raises CalibrationError if image size, a stated offset of the images on the image sensor, stripe orientation,
    wavelength or focal length differ; the recording was made in water and the calibration has no window; or a
    polynomial calibration was made in another medium, or with the window mounted and the recording without, or the
    reverse.
    """
    camera = header.sensor.camera
    _check_images(camera, calibration, source=source)
    if abs(header.sensor.laser.wavelength_nm - calibration.wavelength_nm) > _LARGEST_CHANGE_NM:
        raise CalibrationError(
            f"{source} was taken with a laser of {header.sensor.laser.wavelength_nm:g} nm, the calibration is for "
            f"{calibration.wavelength_nm:g} nm: use the calibration of this sensor"
        )
    other = header.sensor.name != calibration.sensor_name
    named = f"{source} is of the sensor '{header.sensor.name}', the calibration of '{calibration.sensor_name}'"
    if other and isinstance(calibration, Calibration):
        described, found = camera.focal_length_px(), calibration.camera.fx_px
        # A calibration without a window attributes refraction to the focal length, which becomes a third longer.
        if not 1 / _OTHER_LENS < found / described < 1.33 * _OTHER_LENS:
            raise CalibrationError(
                f"{named}; the sensor's described focal length is {described:.0f} px, the calibrated one is "
                f"{found:.0f} px: calibrate this sensor"
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
            f"{source} was made in air, but the calibration has a single viewpoint in water "
            f"({calibration.medium_kind}), which includes the refraction: calibrate in air"
        )
    warnings = [f"{named}: check that it is the right one"] if other else []
    if (camera.offset_px is None) == bool(_list_offsets(calibration)):
        warnings.append(
            f"only one of {source} and the calibration states the images' offset on the image sensor "
            "(offset_px): check that it is the same"
        )
    level, sources = header.provenance.get("black_level"), Origin.model_validate(calibration.provenance).captures()
    if isinstance(level, int | float) and (known := {source.black_level for source in sources} - {None, level}):
        there = ", ".join(f"{each:g}" for each in known)
        warnings.append(f"{source} has the camera's black level {level:g}, its calibration {there}: set it as before")
    return warnings


def _list_offsets(calibration: AnyCalibration) -> set[tuple[int, int]]:
    """Return the stated offsets of a calibration's images on the image sensor, px."""
    if isinstance(calibration, PolynomialCalibration):
        stated = calibration.provenance.get("offset_px")
        x, y = stated if isinstance(stated, list) and len(stated) == 2 else (None, None)
        return {(x, y)} if isinstance(x, int) and isinstance(y, int) else set()
    return {source.offset_px for source in calibration.origin().captures() if source.offset_px is not None}


def _check_same_refraction(header: CaptureHeader, calibration: PolynomialCalibration, *, source: str) -> None:
    medium = calibration.medium
    index, own_index = calibration.medium_index(header.medium), calibration.medium_index(medium)
    if header.medium.kind != medium.kind or abs(index - own_index) > _LARGEST_INDEX_CHANGE:
        raise CalibrationError(
            f"{source} was made in {header.medium_name} ({header.medium.kind}, n {index:.4f}), the "
            f"polynomials in {calibration.medium_name} ({medium.kind}, n {own_index:.4f}): polynomials are valid only "
            "in the medium of their calibration; calibrate again in this one"
        )
    if header.sensor.camera.window.mounted != calibration.window_mounted:
        here, there = ("without", "with") if calibration.window_mounted else ("with", "without")
        there = f"{there} the camera's window: calibrate again"
        raise CalibrationError(f"{source} was made {here} the camera's window, the polynomials {there}")
