"""Parameters of a calibration with their uncertainties, as certificates, reports, tables and the terminal list them."""

from uwlts.model.calibration import Calibration
from uwlts.model.parameter_keys import ParameterKey, WindowParameter, parse_parameter
from uwlts.model.sensor import Description
from uwlts.pages.numbers import format_to_scale
from uwlts.pages.toolkit import MISSING


class ParameterRow(Description):
    """A parameter: words, unit, value, and standard uncertainties after and before calibration (None: unknown)."""

    name: str
    words: str
    unit: str
    value: float
    std: float | None
    std_before: float | None

    def texts(self) -> tuple[str, str]:
        """Return value and standard uncertainty as text, rounded to two digits of the uncertainty."""
        if self.std is None or not self.std > 0:
            return f"{self.value:.6g}", MISSING
        return format_to_scale(self.value, self.std, digits=2), format_to_scale(self.std, self.std, digits=2)


def parameter_rows(calibration: Calibration) -> tuple[ParameterRow, ...]:
    """Return all estimated parameters."""
    if (joint := calibration.joint) is not None:
        rows = zip(joint.parameters, joint.values, joint.std, joint.std_before, strict=True)
        return tuple(_row(*row) for row in rows)
    camera, window = calibration.camera, calibration.window
    known = calibration.std()
    std = {"f": known.fx_px, "fx": known.fx_px, "fy": known.fy_px, "cx": known.cx_px, "cy": known.cy_px}
    std |= known.distortion
    values = {"f": camera.fx_px} if camera.fx_px == camera.fy_px else {"fx": camera.fx_px, "fy": camera.fy_px}
    values |= {"cx": camera.cx_px, "cy": camera.cy_px}
    values |= {name: value for name, value in camera.distortion.model_dump().items() if value}
    rows = [_row(parse_parameter(name), value, std.get(name)) for name, value in values.items()]
    if window is not None:
        rows.append(_row(WindowParameter.DISTANCE, window.distance_mm, known.window_distance_mm))
        if window.refractions == 2:
            rows.append(_row(WindowParameter.THICKNESS, window.thickness_mm))
            rows.append(_row(WindowParameter.GLASS_INDEX, window.glass_index))
    return tuple(rows)


def _row(key: ParameterKey, value: float, std: float | None = None, before: float | None = None) -> ParameterRow:
    quantity = key.quantity
    return ParameterRow(
        name=key.text,
        words=quantity.words,
        unit=quantity.unit,
        value=value * quantity.factor,
        std=None if std is None else std * quantity.factor,
        std_before=None if before is None else before * quantity.factor,
    )
