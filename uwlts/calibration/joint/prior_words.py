"""Parameters of the joint calibration in words: what was found, what was described, what may be wrong."""

import numpy as np

_SLOPE = "slope"
_ALIGNMENT = "stage_direction in the captures, or uncertainty.stage_alignment_deg"
_WORDS = {
    "window_distance": ("window distance", "mm", "camera.window.distance_mm or uncertainty.window_distance_mm"),
    "window_slope_x": ("window tilt to the right", _SLOPE, "the window's tilts or uncertainty.window_tilt_deg"),
    "window_slope_y": ("window tilt downwards", _SLOPE, "the window's tilts or uncertainty.window_tilt_deg"),
    "glass_thickness": ("thickness of the window's glass", "mm", "camera.window: thickness_mm and mounted"),
    "glass_index": ("index of the window's glass", "", "camera.window.glass"),
    "sheet_bow": ("bow of the laser sheet", "deg", "the target's flatness, the laser, or uncertainty.bow_deg"),
    "laser_window_turn": (
        "tilt of the laser's window against the sheet", "deg", "the medium, or uncertainty.laser_window_tilt_deg",
    ),
    "scan_slope_1": ("the stage's direction in the scans of spheres, along the sheet's normal,", _SLOPE, _ALIGNMENT),
    "scan_slope_2": ("the stage's direction in the scans of spheres, across that,", _SLOPE, _ALIGNMENT),
    "target_bow": ("bend of the target", "mm", "the target's flatness, or uncertainty.target_bow_mm"),
}  # fmt: skip


def off_as_words(name: str, value: float, known: float, std: float, *, sigmas: float) -> str:
    """That the images alone say a value, so many standard uncertainties of both off what was known before."""
    if name == "stage_scale":
        return (
            f"the stage moves {1 + value:.5g} mm per mm of its positions, stated 1 +- {std:g} ({sigmas:.1f} "
            "standard uncertainties off): check the target's spacing and the stage's scale"
        )
    if name.startswith("index of "):
        words, unit, check = f"refractive {name}", "", "the medium and the step's height in the captures, or --index"
    elif name.startswith("height of "):
        words, unit, check = name, "mm", "which standard it is"
    else:
        words, unit, check = _WORDS[name]
    if unit == _SLOPE:
        value, known, std = np.degrees(np.arctan([value, known, std]))
        unit = "deg"
    elif unit == "deg":
        value, known, std = np.degrees([value, known, std])
    digits = max(0, int(np.ceil(1 - np.log10(std))))
    return (
        f"{words} found {value:.{digits}f}{unit and ' ' + unit}, described as {known:.{digits}f} +- {std:.2g} "
        f"({sigmas:.1f} standard uncertainties off): check {check}"
    )
