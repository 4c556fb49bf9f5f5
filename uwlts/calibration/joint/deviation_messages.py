"""Messages that a parameter is off what was described, and what may be wrong."""

from typing import assert_never

from uwlts.calibration.parameter_keys import (
    LensParameter,
    MediumIndex,
    ParameterKey,
    SheetParameter,
    SingleParameter,
    StageParameter,
    StepHeight,
    TargetParameter,
    WindowParameter,
)

_ALIGNMENT = "stage_direction in the captures, or uncertainty.stage_alignment_deg"
_CHECK: dict[SingleParameter, str] = {
    WindowParameter.DISTANCE: "camera.window.distance_mm or uncertainty.window_distance_mm",
    WindowParameter.SLOPE_X: "the window's tilts or uncertainty.window_tilt_deg",
    WindowParameter.SLOPE_Y: "the window's tilts or uncertainty.window_tilt_deg",
    WindowParameter.THICKNESS: "camera.window: thickness_mm and mounted",
    WindowParameter.GLASS_INDEX: "camera.window.glass",
    SheetParameter.BOW: "the target's flatness, the laser, or uncertainty.bow_deg",
    SheetParameter.WINDOW_TURN: "the medium, or uncertainty.laser_window_tilt_deg",
    StageParameter.SLOPE_1: _ALIGNMENT,
    StageParameter.SLOPE_2: _ALIGNMENT,
    TargetParameter.BOW: "the target's flatness, or uncertainty.target_bow_mm",
}
"""What to check of the parameters of which something is known before."""


def format_deviation(key: ParameterKey, value: float, known: float, std: float, *, sigmas: float) -> str:
    """That the images alone say a value, so many standard uncertainties of both off what was known before."""
    match key:
        case StageParameter.SCALE:
            return (
                f"the stage moves {1 + value:.5g} mm per mm of its positions, stated 1 +- {std:g} ({sigmas:.1f} "
                "standard uncertainties off): check the target's spacing and the stage's scale"
            )
        case MediumIndex():
            check = "the medium and the step's height in the captures, or --index"
        case StepHeight():
            check = "which standard it is"
        case LensParameter() | WindowParameter() | SheetParameter() | StageParameter() | TargetParameter():
            check = _CHECK[key]
        case _:
            assert_never(key)
    quantity = key.quantity
    return (
        f"{quantity.words} found {quantity.format_value(value, std)}, described as "
        f"{quantity.format_with_std(known, std)} ({sigmas:.1f} standard uncertainties off): check {check}"
    )
