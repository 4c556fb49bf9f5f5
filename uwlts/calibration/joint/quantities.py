"""What the parameters of a joint estimate are called, and the units in which a metrologist reads them."""

from dataclasses import dataclass

import numpy as np

_DEG = float(np.degrees(1.0))


@dataclass(frozen=True)
class Quantity:
    """A parameter in words, its unit as shown, and how much of that unit one of the estimate's is.

    Slopes count as angles: at 1 deg that is right to a part in 10 000.
    """

    words: str
    unit: str = ""
    factor: float = 1.0

    def shown(self, value: float, std: float) -> str:
        """A value of the estimate as a number of the unit, to the digits that its standard uncertainty leaves."""
        digits = max(0, int(np.ceil(1 - np.log10(self.factor * std))))
        return f"{self.factor * value:.{digits}f}"

    def shown_with(self, value: float, std: float) -> str:
        """The same with the standard uncertainty and the unit."""
        return f"{self.shown(value, std)} +- {self.factor * std:.2g}{self.unit and ' '}{self.unit}"


_QUANTITIES = {
    "f": Quantity("focal length", "px"),
    "fx": Quantity("focal length along the rows", "px"),
    "fy": Quantity("focal length along the columns", "px"),
    "cx": Quantity("column of the principal point", "px"),
    "cy": Quantity("row of the principal point", "px"),
    "window_distance": Quantity("window distance", "mm"),
    "window_slope_x": Quantity("window tilt to the right", "°", _DEG),
    "window_slope_y": Quantity("window tilt downwards", "°", _DEG),
    "glass_thickness": Quantity("thickness of the window's glass", "mm"),
    "glass_index": Quantity("index of the window's glass"),
    "sheet_turn_fan": Quantity("turn of the sheet about its fan's direction", "°", _DEG),
    "sheet_turn_axis": Quantity("turn of the sheet about the laser's axis", "°", _DEG),
    "sheet_offset": Quantity("offset of the sheet", "mm"),
    "sheet_bow": Quantity("bow of the sheet", "°", _DEG),
    "laser_window_turn": Quantity("turn of the laser's window", "°", _DEG),
    "stage_scale": Quantity("scale of the stage", "µm/m", 1e6),
    "scan_slope_1": Quantity("lean of the scan's direction (X towards Y)", "°", _DEG),
    "scan_slope_2": Quantity("lean of the scan's direction (X towards Z)", "°", _DEG),
    "target_bow": Quantity("bend of the target", "µm", 1e3),
}


def quantity_of(name: str) -> Quantity:
    """The parameter of a name; distortion coefficients, indices and heights name themselves."""
    if name in _QUANTITIES:
        return _QUANTITIES[name]
    if name.startswith("height of "):
        return Quantity(name, "mm")
    return Quantity(name if name.startswith("index of ") else f"distortion {name}")
