"""Library of descriptions: find them by name or path, read their TOML, and report invalid keys.

Names belong to the library that ships with the package: ``scenes/sensors`` for sensors, ``scenes`` for scenes. A
description can name a ``base`` of its own kind and contain only the differences.

A sensor that changes the wavelength, the stand-off, the lens or a medium of its base keeps all other values of the
base. Some of these follow from the changed ones: the focus distance, the laser's waist, values at a wavelength. They
are checked.
"""

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from uwlts.errors import DescriptionError, DescriptionWarning, DesignError, Error, list_problems
from uwlts.files.reading import is_regular_file, read_toml, shorten
from uwlts.model.placement import apparent_depth_mm, camera_from_object, laser_pose
from uwlts.model.sensor import Description, Sensor, Table, Window

AnyDescription = TypeVar("AnyDescription", bound=Description)


_MOST_PROBLEMS = 30  # of a description that a message lists
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
    stated: Table
    merged: Table


def library_folder() -> Path:
    """Return the folder of the shipped descriptions: inside the wheel, or beside the package in a source checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def list_names(folder: str = "") -> list[str]:
    """Return the names of the shipped descriptions in a folder of the library."""
    return sorted(path.stem for path in (library_folder() / folder).glob("*.toml"))


def find_description(name_or_path: str | Path, folder: str = "") -> Path:
    """Return the path of a description given by file or name; DescriptionError with the known names."""
    path = Path(name_or_path)
    if path.suffix == ".toml":
        if not is_regular_file(path):
            raise DescriptionError(f"no description at {shorten(str(path))}")
        return path
    shipped = library_folder() / folder / f"{name_or_path}.toml"
    if not is_regular_file(shipped):
        known = f"known are {', '.join(list_names(folder))}, or give the path of a .toml file"
        raise DescriptionError(f"nothing is called '{shorten(str(name_or_path))}'; {known}")
    return shipped


def read_table(path: Path, folder: str = "") -> Table:
    """Read a TOML file and merge it with its ``base``: tables are merged, all other values replaced."""
    return read_levels(path, folder)[-1].merged


def read_levels(path: Path, folder: str = "", *, seen: tuple[Path, ...] = ()) -> tuple[Level, ...]:
    """Read a TOML file and its chain of bases, each merged with those before it; the first base is first."""
    table = read_toml(path, called="description", error=DescriptionError)
    if path.resolve() in seen:
        raise DescriptionError(f"{path} is its own base: {' -> '.join(p.name for p in (*seen, path))}")
    base = table.pop("base", None)
    if base is None:
        return (Level(path.stem, table, table),)
    if not isinstance(base, str):
        raise DescriptionError(f"{path}: base is {base!r}; expected the name or path of another description")
    beside = path.parent / f"{base.removesuffix('.toml')}.toml"
    # A description can have the same name as its shipped base.
    base_path = (
        beside if is_regular_file(beside) and beside.resolve() != path.resolve() else find_description(base, folder)
    )
    levels = read_levels(base_path, folder, seen=(*seen, path.resolve()))
    return *levels, Level(path.stem, table, merge_tables(levels[-1].merged, table))


_EITHER_OR = (({"baseline_mm", "triangulation_angle_deg"}, {"origin_mm", "axis"}), ({"water"}, {"turbidity"}))
"""Alternative keys for the same information: placement of the laser, and properties of a medium."""


def merge_tables(base: Table, changes: Table) -> Table:
    """Merge ``changes`` into a copy of ``base``, nested tables key by key.

    Keys of the base are dropped if the changes give the same information with alternative keys, such as the laser's
    placement.
    """
    replaced = {
        key
        for ways in _EITHER_OR
        for stated, other in (ways, ways[::-1])
        if stated & changes.keys() and not other & changes.keys()
        for key in other
    }
    result = {key: value for key, value in base.items() if key not in replaced}
    for key, value in changes.items():
        below = base.get(key)
        result[key] = merge_tables(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return result


def validate_description(model: type[AnyDescription], table: object, source: str | Path) -> AnyDescription:
    """Validate a table as a description; DescriptionError with each invalid key, its value and the expected one."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", model.__name__).lower()
        known = [_explain(each, model) for each in list_problems(error, _MOST_PROBLEMS)]
        left = error.error_count() - len(known)
        more = [f"  {left:,} {'more ' if known else ''}values are wrong"] if left else []
        raise DescriptionError("\n".join([f"{source} is not a valid {text}:", *known, *more])) from error
    except Error as error:
        raise type(error)(f"{source}: {error}") from error
    except ArithmeticError as error:
        raise DescriptionError(f"{source} contains numbers outside the range of calculations: {error}") from error


def _explain(problem: ErrorDetails, model: type[Description]) -> str:
    # The default kind of a tagged union has an empty tag.
    key = ".".join(str(part) for part in problem["loc"] if part != "") or "(whole description)"
    if problem["type"] == "extra_forbidden":
        keys = ", ".join(_list_keys(model, problem["loc"][:-1]))
        return f"  {key}: unknown key (check its spelling and its unit suffix; the keys here are {keys})"
    if problem["type"] == "missing":
        return f"  {key}: missing"
    found = "" if isinstance(problem["input"], dict) else f" (found {shorten(repr(problem['input']))})"
    return f"  {key}: {problem['msg'].removeprefix('Value error, ')}{found}"


def _list_keys(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """Return the keys that a description has at a location, which consists of keys, indices and kinds."""
    models: list[type[BaseModel]] = [model]
    for part in location:
        fields = [each.model_fields[str(part)] for each in models if part in each.model_fields]
        if fields:
            models = [each for field in fields for each in _list_models(field.annotation)]
        else:
            kinds = [(each, each.model_fields.get("kind")) for each in models]
            models = [each for each, kind in kinds if part in (get_args(kind.annotation) if kind else ("",))] or models
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def _list_models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [each for part in get_args(annotation) for each in _list_models(part)]


def load_sensor(name_or_path: str | Path) -> Sensor:
    """Read a sensor description: a shipped one by name, such as "thesis", or a TOML file, which can have a ``base``.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a shipped description, or path of a TOML file.

    Returns
    -------
    Sensor
        Nominal data of camera, laser, windows, detector, stage, measuring volume and media.

    Raises
    ------
    DescriptionError
        The name is unknown, or the file is missing, not TOML, or has an unknown key or an invalid value.

    Warns
    -----
    DescriptionWarning
        A value of the base does not fit what the description changes, such as the focus after another stand-off.

    Examples
    --------
    >>> sensor = uwlts.load_sensor("thesis")
    >>> sensor.medium("water").refractive_index(sensor.laser.wavelength_nm)
    """
    path = find_description(name_or_path, "sensors")
    return validate_sensor(read_levels(path, "sensors"), path)


def validate_sensor(levels: Sequence[Level], source: str | Path) -> Sensor:
    """Validate a chain of descriptions as a sensor; DescriptionWarning for inherited values that no longer fit."""
    sensor = validate_description(Sensor, levels[-1].merged, source)
    for text in find_misfits(levels, sensor):
        warnings.warn(text, DescriptionWarning, stacklevel=3)
    return sensor


def _look_up(table: object, path: str) -> object:
    for key in path.split("."):
        table = table.get(key) if isinstance(table, dict) else None
    return table


def _format_value(value: object) -> str:
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
        set_by = [level for level in self._levels if _look_up(level.stated, path) is not None]
        if not set_by or set_by[-1] is self._last or _look_up(self._last.merged, path) is None:
            return None
        return set_by[-1]

    def changes(self, origin: Level, paths: Sequence[str]) -> list[str]:
        """Return as text the keys among ``paths`` whose values differ from those at a level."""
        pairs = ((path, _look_up(origin.merged, path), _look_up(self._last.merged, path)) for path in paths)
        return [
            f"{path} ({f'{_format_value(before)} to ' if before is not None else 'now '}{_format_value(after)})"
            for path, before, after in pairs
            if after is not None and _differ(path, before, after)
        ]

    def say(self, path: str, depends_on: Sequence[str], misfit: str, advice: str) -> list[str]:
        """Return a warning about an inherited value if a value on which it depends has changed since; else nothing."""
        origin = self.origin(path)
        changed = [] if origin is None else self.changes(origin, depends_on)
        if origin is None or not changed:
            return []
        value = _format_value(_look_up(self._last.merged, path))
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
    advice = "state it in this description"
    found = inherited.say("name", _PARTS, "", "give this sensor its own name, because calibrations are compared by it")
    found += inherited.say("notes", _PARTS, "", "describe this sensor, or set notes to an empty text")
    found += _check_places(inherited, sensor)
    nm = f"{sensor.laser.wavelength_nm:g} nm"
    radius, before = sensor.laser.waist_radius_mm, inherited.origin("laser.waist_radius_mm")
    old_nm = _look_up(before.merged, _WAVELENGTH) if before is not None else None
    if isinstance(old_nm, int | float) and old_nm > 0:
        scaled = radius * sensor.laser.wavelength_nm / old_nm
        misfit = f"; the same line optics focus {nm} to {scaled:.3g} mm"
        found += inherited.say("laser.waist_radius_mm", [_WAVELENGTH], misfit, advice)
    for path in _AT_WAVELENGTH:
        if not isinstance(_look_up(levels[-1].merged, path), str):
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
        name: _compute_apparent_mm(camera.window, standoff, index=index, wavelength_nm=laser.wavelength_nm)
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
    to_standoff = float(np.linalg.norm(laser_pose(sensor).origin_mm - (0.0, 0.0, standoff)))
    index = max(indices.values(), default=1.0)
    rayleigh = math.pi * laser.waist_radius_mm**2 * index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
    thicker = math.hypot(1.0, (to_standoff - laser.waist_distance_mm) / rayleigh)
    if thicker > _THICKER:
        misfit = f"; at the stand-off the sheet is {thicker:.2f} times as thick as in its waist"
        depends_on = [*_PLACEMENT, _WAVELENGTH, "laser.waist_radius_mm", "laser.beam_quality_m2", *media]
        advice = f"set it to the laser's distance from the stand-off, {to_standoff:.1f}"
        yield from inherited.say("laser.waist_distance_mm", depends_on, misfit, advice)
    outside = standoff - camera.window.distance_mm - camera.window.thickness_mm
    if not volume.near_mm <= outside <= volume.far_mm:
        misfit = f"the stand-off, {outside:.1f} mm from the window, is outside the measuring volume"
        advice, depends_on = "set near_mm and far_mm about the stand-off", [*_PLACEMENT, *window]
        keys = "volume.near_mm", "volume.far_mm"
        texts = [text for key in keys for text in inherited.say(key, depends_on, f"; {misfit}", advice)]
        yield (texts or [f"{inherited.name}: {misfit} of {volume.near_mm:g} to {volume.far_mm:g} mm: {advice}"])[0]


def _compute_apparent_mm(window: Window, distance_mm: float, *, index: float, wavelength_nm: float) -> float:
    """Return the apparent distance from the pupil, for paraxial rays, of a point behind a window."""
    if not window.mounted:
        return distance_mm
    behind = window.distance_mm, window.thickness_mm
    return apparent_depth_mm(distance_mm, *behind, glass_index=window.index(wavelength_nm), medium_index=index)


def _check_medium(inherited: _Inherited, name: str, nm: str) -> Iterator[str]:
    """Yield warnings about inherited optical constants of a medium."""
    at = f"media.{name}"
    kind = f"{at}.kind"
    stated = {
        "index": [kind, f"{at}.temperature_c", f"{at}.salinity_g_kg"],
        "absorption_per_m": [kind, f"{at}.water", f"{at}.turbidity"],
        "scattering_per_m": [kind, f"{at}.water", f"{at}.turbidity"],
        "phase": [kind, f"{at}.water", f"{at}.turbidity"],
    }
    for key, depends_on in stated.items():
        misfit = "; it replaces the value that follows from them"
        advice = f"set the value of this medium at {nm}, or give the medium another name"
        of_medium = [*inherited.say(f"{at}.{key}", depends_on, misfit, advice)]
        if not of_medium and key != "phase":
            of_medium = inherited.say(f"{at}.{key}", [_WAVELENGTH], "", f"set the value at {nm}")
        yield from of_medium
