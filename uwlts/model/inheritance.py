"""Check of a sensor description for values that are inherited from a base and no longer fit.

A description that changes the wavelength, the stand-off, the lens or a medium of its base keeps all other values of the
base. Some of these follow from the changed ones: the focus distance, the laser's waist, values at a wavelength.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.errors import DesignError
from uwlts.model.placement import apparent_depth_mm, camera_from_object, laser_pose
from uwlts.model.sensor import Sensor, Table, Window

_SAME_WAVELENGTH_NM = 5.0  # lasers of the same type differ by less
_SAME = 0.1  # relative change of a length, an angle or a power that can be an adjustment of the same part
_BLUR_PX = 2.0
"""Largest diameter of the blur at the stand-off: its standard deviation of half a pixel widens a stripe by a tenth."""
_THICKER = 1.05  # largest thickness of the sheet at the stand-off, relative to that in its waist

_WAVELENGTH = "laser.wavelength_nm"
_PLACEMENT = tuple(
    f"laser.{key}" for key in ("baseline_mm", "triangulation_angle_deg", "origin_mm", "axis", "roll_deg")
)
_LENS = ("camera.focal_length_mm",)
_PARTS = (
    *(_WAVELENGTH, "laser.power_mw", *_PLACEMENT, *_LENS),
    *(f"{module}.window.{key}" for module in ("camera", "laser") for key in ("glass", "thickness_mm")),
)
_AT_WAVELENGTH = (
    "detector.quantum_efficiency",
    *(f"{module}.window.{key}" for module in ("camera", "laser") for key in ("glass", "absorption_per_m")),
)


@dataclass(frozen=True)
class Level:
    """One description of a chain of bases: its name, its own table, and the table merged with those of its bases."""

    name: str
    own: Table
    merged: Table


def _value(table: object, path: str) -> object:
    for key in path.split("."):
        table = table.get(key) if isinstance(table, dict) else None
    return table


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value)


def _differ(path: str, before: object, after: object) -> bool:
    """Return whether two values of a key belong to different parts, or to different places of a part."""
    numbers = [value for value in (before, after) if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(numbers) < 2:
        return before != after
    allowed = _SAME_WAVELENGTH_NM if path == _WAVELENGTH else _SAME * abs(numbers[0])
    return abs(numbers[1] - numbers[0]) > allowed


class _Inherited:
    """Values of the last level of a chain that other levels set."""

    def __init__(self, levels: Sequence[Level]):
        self._levels, self._last = levels, levels[-1]

    @property
    def name(self) -> str:
        """Name of the last level."""
        return self._last.name

    def origin(self, path: str) -> Level | None:
        """Return the level that an inherited value is from; None for a value of the last level and for a default."""
        set_by = [level for level in self._levels if _value(level.own, path) is not None]
        if not set_by or set_by[-1] is self._last or _value(self._last.merged, path) is None:
            return None
        return set_by[-1]

    def changes(self, origin: Level, paths: Sequence[str]) -> list[str]:
        """Return as text the keys among ``paths`` whose values differ from those at a level."""
        pairs = ((path, _value(origin.merged, path), _value(self._last.merged, path)) for path in paths)
        return [
            f"{path} ({f'{_text(before)} to ' if before is not None else 'now '}{_text(after)})"
            for path, before, after in pairs
            if after is not None and _differ(path, before, after)
        ]

    def say(self, path: str, depends_on: Sequence[str], misfit: str, advice: str) -> list[str]:
        """Return a warning about an inherited value if a value on which it depends has changed since; else nothing."""
        origin = self.origin(path)
        changed = [] if origin is None else self.changes(origin, depends_on)
        if origin is None or not changed:
            return []
        value = _text(_value(self._last.merged, path))
        because = f"but this description changes {', '.join(changed)}{misfit}"
        return [f"{self.name}: {path} = {value} is inherited from '{origin.name}', {because}: {advice}"]


def find_misfits(levels: Sequence[Level], sensor: Sensor) -> list[str]:
    """Return warnings about inherited values of a sensor description that no longer fit.

    A value is checked if the description, or a base between it and the value's origin, changes a value on which it
    depends: wavelength, placement of the laser, focal length, window or medium.

    - ``name`` and ``notes`` fit if no such part changes by more than 10 %, or the wavelength by more than 5 nm.
    - ``camera.focus_distance_mm`` fits if it is between the stand-off and its apparent distances in the media, or blurs
      the stand-off by at most 2 px.
    - ``laser.waist_distance_mm`` fits if the sheet at the stand-off is at most 1.05 times as thick as in its waist.
    - ``laser.waist_radius_mm`` and values at the laser's wavelength do not fit another wavelength.
    - ``volume`` fits if it contains the stand-off.
    - ``camera.principal_point_px`` does not fit another image size, nor ``camera.distortion`` another lens.
    - Optical constants of a medium do not fit another medium.

    ``levels`` lead from the first base to the description itself. Only its own ``volume`` is checked, too.
    """
    inherited = _Inherited(levels)
    own = "state it in this description"
    found = inherited.say("name", _PARTS, "", "give this sensor its own name, because calibrations are compared by it")
    found += inherited.say("notes", _PARTS, "", "describe this sensor, or set notes to an empty text")
    found += _check_places(inherited, sensor)
    nm = f"{sensor.laser.wavelength_nm:g} nm"
    radius, before = sensor.laser.waist_radius_mm, inherited.origin("laser.waist_radius_mm")
    old_nm = _value(before.merged, _WAVELENGTH) if before is not None else None
    if isinstance(old_nm, int | float) and old_nm > 0:
        scaled = radius * sensor.laser.wavelength_nm / old_nm
        misfit = f"; the same line optics focus {nm} to {scaled:.3g} mm"
        found += inherited.say("laser.waist_radius_mm", [_WAVELENGTH], misfit, own)
    for path in _AT_WAVELENGTH:
        if not isinstance(_value(levels[-1].merged, path), str):
            material = ", or name a material such as 'N-BK7'" if path.endswith("glass") else ""
            found += inherited.say(path, [_WAVELENGTH], "", f"set the value at {nm}{material}")
    size = ["camera.width_px", "camera.height_px"]
    found += inherited.say("camera.principal_point_px", size, "", "set the principal point of these images")
    if any(sensor.camera.distortion.model_dump().values()):
        found += inherited.say("camera.distortion", _LENS, "", "set the coefficients of this lens")
    for name in sensor.media:
        found += _check_medium(inherited, name, nm)
    return found


def _check_places(inherited: _Inherited, sensor: Sensor) -> Iterator[str]:
    """Yield warnings about focus, waist and measuring volume, which follow the stand-off."""
    camera, laser, volume = sensor.camera, sensor.laser, sensor.volume
    try:
        standoff = float(camera_from_object(sensor)[2, 3])
    except DesignError:
        # The design itself is wrong; commands that use the sensor say so.
        return
    media = [f"media.{name}.{key}" for name in sensor.media for key in ("kind", "index", "temperature_c")]
    window = ["camera.window.distance_mm", "camera.window.thickness_mm"]
    indices = {name: medium.refractive_index(laser.wavelength_nm) for name, medium in sensor.media.items()}
    seen = {
        name: _apparent_mm(camera.window, standoff, index=index, wavelength_nm=laser.wavelength_nm)
        for name, index in indices.items()
    }
    nearest, farthest = min(standoff, *seen.values()), max(standoff, *seen.values())
    focus = camera.focus_distance_mm
    pupil = camera.focal_length_mm / camera.f_number
    blur = pupil * abs(1 / focus - 1 / min(max(focus, nearest), farthest)) * camera.focal_length_px()
    if blur > _BLUR_PX:
        places = ", ".join(f"{distance:.1f} in {name}" for name, distance in seen.items())
        misfit = f"; the stand-off, {standoff:.1f} mm from the pupil, is blurred by {blur:.1f} px"
        advice = (
            f"set it to the apparent distance in mm of the stand-off ({places}), and f_number ({camera.f_number:g})"
        )
        yield from inherited.say("camera.focus_distance_mm", [*_PLACEMENT, *_LENS, *window, *media], misfit, advice)
    away = float(np.linalg.norm(laser_pose(sensor).origin_mm - (0.0, 0.0, standoff)))
    index = max(indices.values(), default=1.0)
    rayleigh = math.pi * laser.waist_radius_mm**2 * index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
    thicker = math.hypot(1.0, (away - laser.waist_distance_mm) / rayleigh)
    if thicker > _THICKER:
        misfit = f"; at the stand-off the sheet is {thicker:.2f} times as thick as in its waist"
        depends_on = [*_PLACEMENT, _WAVELENGTH, "laser.waist_radius_mm", "laser.beam_quality_m2", *media]
        advice = f"set it to the laser's distance from the stand-off, {away:.1f}"
        yield from inherited.say("laser.waist_distance_mm", depends_on, misfit, advice)
    outside = standoff - camera.window.distance_mm - camera.window.thickness_mm
    if not volume.near_mm <= outside <= volume.far_mm:
        misfit = f"the stand-off, {outside:.1f} mm from the window, is outside the measuring volume"
        advice, depends_on = "set near_mm and far_mm about the stand-off", [*_PLACEMENT, *window]
        keys = "volume.near_mm", "volume.far_mm"
        said = [text for key in keys for text in inherited.say(key, depends_on, f"; {misfit}", advice)]
        yield (said or [f"{inherited.name}: {misfit} of {volume.near_mm:g} to {volume.far_mm:g} mm: {advice}"])[0]


def _apparent_mm(window: Window, distance_mm: float, *, index: float, wavelength_nm: float) -> float:
    """Return the apparent distance from the pupil, for paraxial rays, of a point behind a window."""
    if not window.mounted:
        return distance_mm
    behind = window.distance_mm, window.thickness_mm
    return apparent_depth_mm(distance_mm, *behind, glass_index=window.index(wavelength_nm), medium_index=index)


def _check_medium(inherited: _Inherited, name: str, nm: str) -> Iterator[str]:
    """Yield warnings about inherited optical constants of a medium."""
    at = f"media.{name}"
    kind = f"{at}.kind"
    own = {
        "index": [kind, f"{at}.temperature_c", f"{at}.salinity_g_kg"],
        "absorption_per_m": [kind, f"{at}.water", f"{at}.turbidity"],
        "scattering_per_m": [kind, f"{at}.water", f"{at}.turbidity"],
        "phase": [kind, f"{at}.water", f"{at}.turbidity"],
    }
    for key, depends_on in own.items():
        misfit = "; it replaces the value that follows from them"
        advice = f"set the value of this medium at {nm}, or give the medium another name"
        of_medium = [*inherited.say(f"{at}.{key}", depends_on, misfit, advice)]
        if not of_medium and key != "phase":
            of_medium = inherited.say(f"{at}.{key}", [_WAVELENGTH], "", f"set the value at {nm}")
        yield from of_medium
