"""Parameters and single residual figures of calibrations side by side."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from uwlts.calibration.model import Calibration
from uwlts.calibration.nominal import nominal_calibration
from uwlts.report.gather import Campaign, GatheredCalibration
from uwlts.report.numbers import fixed, is_number, plain, unit_of, words_of
from uwlts.report.page_toolkit import MISSING, Comparison

SHORT_LIST = 3
"""Lists up to this length are written out; longer ones are drawn."""

_STD_NAMES = {"fx_px": ("fx", "f"), "fy_px": ("fy", "f"), "cx_px": ("cx",), "cy_px": ("cy",)}


def parameter_table(campaign: Campaign) -> Comparison:
    """All parameters with their units and, where known, standard deviations; a last column of a twin's true values."""
    columns = [found.name for found in campaign.calibrations]
    parameters = [_parameters(found.calibration) for found in campaign.calibrations]
    if campaign.true_sensor is not None:
        columns.append("true")
        parameters.append(_parameters(nominal_calibration(campaign.true_sensor)))
    names = dict.fromkeys(name for table in parameters for name in table)
    return Comparison(
        tuple(columns),
        tuple((*name, tuple(table.get(name, MISSING) for table in parameters)) for name in names),
    )


def residual_table(calibrations: tuple[GatheredCalibration, ...]) -> Comparison:
    """Every single figure that the residuals of the calibrations hold, by its name."""
    tables = [dict(_figures(found.calibration.residuals_in_file(), "")) for found in calibrations]
    names = dict.fromkeys(name for table in tables for name in table)
    return Comparison(
        tuple(found.name for found in calibrations),
        tuple((*name, tuple(table.get(name, MISSING) for table in tables)) for name in names),
    )


def _parameters(calibration: Calibration) -> dict[tuple[str, str], str]:
    camera, window, sheet = calibration.camera, calibration.window, calibration.sheet
    std = _camera_std(calibration)
    table = {}
    for key, words in {"fx_px": "focal length, x", "fy_px": "focal length, y", "cx_px": "principal point, x",
                       "cy_px": "principal point, y"}.items():  # fmt: skip
        known = next((std[name] for name in _STD_NAMES[key] if name in std), None)
        table[words, "px"] = _with_std(getattr(camera, key), known, 3)
    for name in ("k1", "k2", "k3", "p1", "p2"):
        table[f"distortion {name}", ""] = _with_std(getattr(camera.distortion, name), std.get(name), 6)
    pose = calibration.object_transform()
    table["stand-off: sheet on the camera's axis", "mm"] = fixed(pose[2, 3])
    table["angle between camera and sheet", "°"] = fixed(math.degrees(math.asin(min(1, abs(sheet.normal[2])))), 4)
    table["sheet's distance from the camera", "mm"] = fixed(sheet.offset_mm)
    if window is not None:
        table["refractions", ""] = str(window.refractions)
        residuals = calibration.residuals.get("window")
        known = residuals.get("std_mm") if isinstance(residuals, dict) else None
        table["window distance d", "mm"] = _with_std(window.distance_mm, known if is_number(known) else None, 3)
        cosine = float(window.normal[2] / np.linalg.norm(window.normal))
        table["window tilt", "°"] = fixed(math.degrees(math.acos(min(1, cosine))), 3)
        if window.refractions == 2:
            table["glass thickness", "mm"] = fixed(window.thickness_mm)
            table["index of the glass", ""] = fixed(window.glass_index, 4)
    return table


def _camera_std(calibration: Calibration) -> dict[str, float]:
    camera = calibration.residuals.get("camera")
    std = camera.get("std") if isinstance(camera, dict) else None
    return {name: value for name, value in std.items() if is_number(value)} if isinstance(std, dict) else {}


def _with_std(value: float, std: float | None, decimals: int) -> str:
    """A value, and its standard deviation with two significant digits; both with the same decimals."""
    if std is None or not std > 0:
        return fixed(value, decimals)
    decimals = max(0, 1 - math.floor(math.log10(std)))
    return f"{fixed(value, decimals)} ± {fixed(std, decimals)}"


def _figures(table: dict[str, Any], group: str) -> Iterator[tuple[tuple[str, str], str]]:
    for name, value in table.items():
        words = f"{group}: {words_of(name)}" if group else words_of(name)
        if isinstance(value, dict):
            # Standard deviations of the camera stand beside its parameters.
            if (group, name) != ("camera", "std"):
                yield from _figures(value, f"{group} {name}".strip())
        elif isinstance(value, bool) or is_number(value):
            yield (words, unit_of(name)), plain(value) if is_number(value) else ("yes" if value else "no")
        elif isinstance(value, str):
            yield (words, ""), value
        elif isinstance(value, list) and 0 < len(value) <= SHORT_LIST and all(map(is_number, value)):
            yield (words, unit_of(name)), ", ".join(map(plain, value))
