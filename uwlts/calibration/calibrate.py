"""Calibration of a sensor from its captures, by the method that they need."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, assert_never

from uwlts.calibration.evidence import Progress
from uwlts.calibration.joint.procedure import calibrate_jointly
from uwlts.calibration.sequential import CalibrationOptions, calibrate_sequentially
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CalibrationError
from uwlts.storage.capture import Capture

CalibrationMethod = Literal["auto", "sequential", "joint"]
_Captures = Sequence[Capture | str | Path]


def calibrate(
    *,
    air: _Captures = (),
    water: _Captures = (),
    step: _Captures = (),
    scan: _Captures = (),
    method: CalibrationMethod = "auto",
    options: CalibrationOptions | None = None,
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
        all captures at once, with their covariance. auto: joint where ``water`` or ``scan`` needs it, else sequential.

    Returns
    -------
    Calibration
        The warnings about its evidence are those of its `Calibration.origin`.

    Raises
    ------
    CalibrationError
        The captures do not determine the calibration or contradict it, or the method cannot use them.
    DescriptionError
        A capture does not describe its target, its step standard or what it scans.
    CaptureError
        A file is missing or damaged, or a scan shows no stripe.
    """
    if method == "auto":
        method = "joint" if water or scan else "sequential"
    with ExitStack() as stack:
        in_air, on_steps, in_water, scans = (
            [each if isinstance(each, Capture) else stack.enter_context(Capture(each)) for each in captures]
            for captures in (air, step, water, scan)
        )
        match method:
            case "joint":
                return calibrate_jointly(
                    [*in_air, *in_water], on_steps, scans, options=options, progress=progress
                ).calibration
            case "sequential":
                if in_water or scans:
                    raise CalibrationError(
                        "the sequential calibration takes a target in air and steps only: calibrate jointly with "
                        "targets in water or scans"
                    )
                return calibrate_sequentially(in_air, on_steps, options=options, progress=progress).calibration
            case _:
                assert_never(method)
