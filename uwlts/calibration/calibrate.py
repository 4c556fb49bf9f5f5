"""Calibration of a sensor from its captures, by the method that they need."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, assert_never

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import Distortion, LensChoice, Pixels
from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.capture_evidence import Progress
from uwlts.calibration.joint.procedure import calibrate_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.calibration import Calibration
from uwlts.optics.window import require_index
from uwlts.storage.capture import Capture, opened_captures
from uwlts.stripe import StripeSettings

_Captures = Sequence[Capture | str | Path]


def calibrate(
    *,
    air: _Captures = (),
    water: _Captures = (),
    step: _Captures = (),
    scan: _Captures = (),
    method: Literal["auto", "sequential", "joint"] = "auto",
    new_water: bool = False,
    unknown_sizes: bool = False,
    strict: bool = False,
    refractions: Literal[1, 2] = 2,
    poses: Poses = "stage-normal",
    distortion: Distortion = "auto",
    pixels: Pixels = "auto",
    index: float | None = None,
    stripe: StripeSettings = None,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate a sensor from captures, open ones or by their paths.

    Parameters
    ----------
    air : sequence of Capture or path
        A target in air, under the lamp and with the laser at the same stage positions.
    water : sequence of Capture or path
        The same in the medium of use.
    step : sequence of Capture or path
        A step standard in the medium of use.
    scan : sequence of Capture or path
        Scans of spheres, a plane or a pipe that stand still while the stage moves the sensor.
    method : {"auto", "sequential", "joint"}
        sequential: camera and sheet from ``air``, then the window's distance from ``step``. joint: all parameters from
        all captures at once, with their covariance. auto: joint if ``water`` or ``scan`` needs it, else sequential.
    new_water : bool
        The scans were taken in other water than the target, or on another day: its index is a parameter of its own.
    unknown_sizes : bool
        Estimate the diameters and spacings of what was scanned, even if the captures state their uncertainty.
    strict : bool
        Jointly: refuse images that do not fit the model. Otherwise single ones are left out, and what most images show
        is stated as an error of the model, which makes uncertainties larger; both with a warning.
    refractions : {1, 2}
        2: a window of known thickness; the images in air are taken without it. 1: a single interface; the images in air
        are taken through the window, whose effect goes into the distortion. The joint method ignores it.
    poses : {"stage-normal", "stage", "free"}
        stage-normal: one target pose, moved by the stage along the target's normal. stage: the same in a free
        direction, as always in the joint method. free: every image has a pose of its own.
    distortion : "auto" or tuple of str
        The coefficients among k1 to k6, p1 and p2 to estimate; the others are 0. auto: with the poses stage and free
        those that predict images of the target left out best; with stage-normal k1 and k2; jointly k1 and k2, p1
        and p2 as far as the description leaves them open, and more where the images contradict that.
    pixels : {"auto", "square", "free"}
        Whether one focal length or two are estimated. auto: as distortion, where poses are free; else one. Of one, the
        other follows by the sensor's ``pixel_aspect``.
    index : float, optional
        Refractive index of the medium relative to air, in place of the one that follows from the captures.
    stripe : StripeOptions or dict, optional
        How stripes are found: all options, or settings in place of those in the sensor's table [stripe].
    progress : callable, optional
        Called with the name of the stage, the number of images done, and the number in all.

    Returns
    -------
    Calibration
        The warnings about its evidence are those of its `Calibration.origin`.

    Raises
    ------
    CalibrationError
        The captures do not determine the calibration or contradict it, or the method cannot use them.
    DescriptionError
        There is no capture of a target, or one does not describe its target, its step standard or what it scans.
    CaptureError
        A file is missing or damaged, or a scan shows no stripe.
    RangeError
        The refractive index is not that of a medium.
    """
    if index is not None:
        require_index(index)
    if not (air or water):
        raise DescriptionError("nothing to calibrate from: give --air or --water with captures of a target, or --live")
    if (new_water or unknown_sizes) and not scan:
        raise DescriptionError("--new-water and --unknown-sizes are about scans: give these with --scan")
    options = CalibrationOptions(
        refractions=refractions,
        poses=poses,
        camera=CameraOptions(
            ("k1", "k2") if distortion == "auto" else distortion, pixel_aspect=None if pixels == "free" else 1.0
        ),
        lens=LensChoice(distortion, pixels),
        stripe=stripe,
        medium_index=index,
        same_water=not new_water,
        sizes_known=not unknown_sizes,
        strict=strict,
    )
    if method == "auto":
        method = "joint" if water or scan else "sequential"
    with (
        opened_captures(air) as in_air,
        opened_captures(step) as steps,
        opened_captures(water) as in_water,
        opened_captures(scan) as scans,
    ):
        for capture in in_water:
            if capture.header.medium.kind == "air":
                raise DescriptionError(
                    f"{capture.path.name} says that it was taken in air: give it with --air, or correct the medium in "
                    "its description"
                )
        match method:
            case "joint":
                targets = [*in_air, *in_water]
                return calibrate_jointly(targets, steps, scans, options=options, progress=progress).calibration
            case "sequential":
                if in_water or scans:
                    raise CalibrationError(
                        "the sequential calibration takes a target in air and steps only: calibrate jointly with "
                        "targets in water or scans"
                    )
                return calibrate_sequentially(in_air, steps, options=options, progress=progress).calibration
            case _:
                assert_never(method)
