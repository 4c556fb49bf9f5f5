"""That a parameter is off what was described, in words, and what may be wrong."""

from uwlts.calibration.joint.quantities import quantity_of

_ALIGNMENT = "stage_direction in the captures, or uncertainty.stage_alignment_deg"
_CHECK = {
    "window_distance": "camera.window.distance_mm or uncertainty.window_distance_mm",
    "window_slope_x": "the window's tilts or uncertainty.window_tilt_deg",
    "window_slope_y": "the window's tilts or uncertainty.window_tilt_deg",
    "glass_thickness": "camera.window: thickness_mm and mounted",
    "glass_index": "camera.window.glass",
    "sheet_bow": "the target's flatness, the laser, or uncertainty.bow_deg",
    "laser_window_turn": "the medium, or uncertainty.laser_window_tilt_deg",
    "scan_slope_1": _ALIGNMENT,
    "scan_slope_2": _ALIGNMENT,
    "target_bow": "the target's flatness, or uncertainty.target_bow_mm",
}


def off_as_words(name: str, value: float, known: float, std: float, *, sigmas: float) -> str:
    """That the images alone say a value, so many standard uncertainties of both off what was known before."""
    if name == "stage_scale":
        return (
            f"the stage moves {1 + value:.5g} mm per mm of its positions, stated 1 +- {std:g} ({sigmas:.1f} "
            "standard uncertainties off): check the target's spacing and the stage's scale"
        )
    if name.startswith("index of "):
        check = "the medium and the step's height in the captures, or --index"
    elif name.startswith("height of "):
        check = "which standard it is"
    else:
        check = _CHECK[name]
    quantity = quantity_of(name)
    return (
        f"{quantity.words} found {quantity.shown(value, std)}, described as {quantity.shown_with(known, std)} "
        f"({sigmas:.1f} standard uncertainties off): check {check}"
    )
