"""Camera calibrations of other programs: OpenCV, Kalibr, ROS CameraInfo; equidistant lenses become rational ones."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from uwlts.errors import DescriptionError
from uwlts.files.reading import MOST_DEPTH, read_text, require_plain, shorten
from uwlts.model.library import merge_tables, validate_description
from uwlts.model.sensor import Distortion, Sensor

# Alternative names, compared without case and underscores.
_MATRIX = ("cameramatrix", "intrinsicmatrix", "k", "m1")
_COEFFICIENTS = ("distortioncoefficients", "distcoeffs", "distortioncoeffs", "distcoef", "d", "d1")
_BROWN_CONRADY = ("", "plumbbob", "rationalpolynomial", "radtan", "radialtangential", "brownconrady")
_BROWN_CONRADY += ("opencv", "fullopencv")
_PINHOLES = ("pinhole", "perspective", "none")
_EQUIDISTANT = ("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4", "kb4")
"""Names of the model of `cv2.fisheye` in ROS, Kalibr and others."""
_MODELS = ("distortionmodel", "distortiontype", "projectionmodel", "lensmodel")
"""Names that state nothing but the lens model, so that an unknown value is a foreign model."""
_MAYBE_MODELS = ("cameramodel", "cameratype", "model", "modeltype", "type", "projection", "lens", "lenstype")
"""Names that may state something else, such as the product, so that only values in `_FOREIGN` are foreign models."""
_FOREIGN = re.compile(
    "fisheye|equi|kannala|kb[0-9]*$|omni|mei$|scaramuzza|ocam|fov$|ftheta|doublesphere|ds$|eucm|ucm|"
    "unified|division|spherical|panoram|cylind|stereographic|orthographic|thinprism|inversebrown|modifiedbrown|"
    "telecentric"
)
_NO = ("", "0", "0.0", "false", "no", "off", "none")

_MOST_BYTES = 2**20  # hundreds of times a usual file
_LARGEST = 1e9
"""Focal lengths in px and coefficients are far below this value; their products do not overflow."""
_SQUARE = 0.005  # calibrations of square pixels find focal lengths that differ by less


_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):
    """Plain YAML with OpenCV's matrices as tables."""


_Loader.add_multi_constructor(
    "tag:yaml.org,2002:opencv-", lambda loader, suffix, node: loader.construct_mapping(node, deep=True)
)


@dataclass(frozen=True)
class KnownCamera:
    """Focal lengths and principal point in px, distortion, and image size and offset on the image sensor if given."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Distortion
    size_px: tuple[int, int] | None
    offset_px: tuple[int, int] | None = None


def read_intrinsics(path: Path) -> KnownCamera:
    """Read a camera from an OpenCV file (YAML, XML or JSON), a ROS CameraInfo or a Kalibr file of one camera (YAML).

    The camera matrix of a CameraInfo is that of the whole image sensor: for images of a region (``roi``), the principal
    point is moved by its offset.

    An equidistant lens becomes the rational one that it equals in the image. Raises DescriptionError if the file is
    missing or damaged, lacks camera matrix or distortion, or the camera has neither Brown-Conrady, rational nor
    equidistant distortion.
    """
    text = read_text(
        path, most_bytes=_MOST_BYTES, error=DescriptionError, called="intrinsics", foreign="is not a file of intrinsics"
    )
    # OpenCV's own parser hangs or terminates the process on some damaged files.
    entries = _read_xml(text, path) if text.lstrip().startswith("<?xml") else _read_yaml(text, path)
    equidistant = _is_equidistant(entries, path)
    known = _unpack_kalibr({_simplify_name(key): value for key, value in entries.items()}, path)
    matrix, coefficients = _list_numbers(known, _MATRIX, path), _list_numbers(known, _COEFFICIENTS, path)
    if matrix.size != 9:
        raise DescriptionError(f"{path}: the camera matrix has {matrix.size} elements; expected 3 x 3")
    fx, skew, cx, _, fy, cy = matrix[:6].tolist()
    if not (fx > 0 and fy > 0 and abs(skew) < 1e-6 * fx and np.allclose(matrix[[3, 6, 7, 8]], (0, 0, 0, 1))):
        raise DescriptionError(
            f"{path}: the camera matrix is {matrix.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1 with positive fx, fy"
        )
    size, offset = _read_size(known, path), None
    if region := _read_region(known, path):
        *offset, width, height = region
        cx, cy, size, offset = cx - offset[0], cy - offset[1], (width, height), (offset[0], offset[1])
    if not equidistant:
        return KnownCamera(fx, fy, cx, cy, _make_distortion(coefficients, path), size, offset)
    if len(coefficients) != 4:
        raise DescriptionError(f"{path}: an equidistant lens has 4 coefficients, k1 to k4; found {len(coefficients)}")
    # Without a size, the principal point is taken as the image's centre.
    width, height = size or (2.0 * cx + 1.0, 2.0 * cy + 1.0)
    corner = float(np.hypot(max(cx, width - 1.0 - cx) / fx, max(cy, height - 1.0 - cy) / fy))
    converted = convert_equidistant(coefficients, corner=corner, focal_px=max(fx, fy), source=str(path))
    return KnownCamera(fx, fy, cx, cy, converted, size, offset)


def set_intrinsics(sensor: Sensor, known: KnownCamera, *, source: str) -> Sensor:
    """Return the sensor with focal lengths, principal point and distortion of a known camera.

    Raises DescriptionError if the image size differs.
    """
    camera = sensor.camera
    if known.size_px is not None and known.size_px != (camera.width_px, camera.height_px):
        raise DescriptionError(
            f"{source} is for images of {' x '.join(map(str, known.size_px))} pixels, the sensor's are "
            f"{camera.width_px} x {camera.height_px}: give the intrinsics of this camera at this size"
        )
    offset = known.offset_px or camera.offset_px
    if camera.offset_px not in (None, offset):
        raise DescriptionError(
            f"{source} is for images from {offset} px of the image sensor, the sensor's are from {camera.offset_px} px"
        )
    fx, fy = known.fx_px, known.fy_px
    if abs(fy / fx - 1) < _SQUARE:
        fx = fy = (fx + fy) / 2
    changes = {
        "offset_px": offset,
        "focal_length_mm": 1e-3 * fx * camera.pixel_size_um,
        "pixel_aspect": fy / fx,
        "principal_point_px": [known.cx_px, known.cy_px],
        "distortion": known.distortion.model_dump(),
    }
    return validate_description(Sensor, merge_tables(sensor.model_dump(), {"camera": changes}), source)


def _read_xml(text: str, path: Path) -> dict[str, object]:
    """Return the top-level entries of an OpenCV XML file; text becomes a list of words."""
    if "<!" in text.replace("<!--", ""):
        raise DescriptionError(f"{path} declares a type of document or entities, which no file of OpenCV does")

    def value(element: ElementTree.Element, depth: int) -> object:
        if depth > MOST_DEPTH:
            raise DescriptionError(f"{path} nests its elements more than {MOST_DEPTH} deep")
        if len(element) == 0:
            parts = [word.strip('"') for word in (element.text or "").split()]
            return parts[0] if len(parts) == 1 else parts
        inside = [(child.tag, value(child, depth + 1)) for child in element]
        return [each for _, each in inside] if all(tag == "_" for tag, _ in inside) else dict(inside)

    try:
        return {child.tag: value(child, 2) for child in ElementTree.fromstring(text.encode())}
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DescriptionError(f"{path} is no complete XML: {error}") from error


def _read_yaml(text: str, path: Path) -> dict[str, object]:
    """Return the entries of a YAML or JSON file; JSON is YAML except for tabs."""
    if text.startswith("%YAML"):
        # OpenCV writes "%YAML:1.0", which is not valid YAML.
        text = text.partition("\n")[2]
    if text.lstrip().startswith("{"):
        text = text.expandtabs(1)
    try:
        _refuse_references(text)
        # The output of `rostopic echo` ends with a separator of documents.
        entries = next(iter(yaml.load_all(text, _Loader)), None)
        require_plain(entries)
    except RecursionError as error:
        raise DescriptionError(f"{path} nests its tables and lists too deep") from error
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise DescriptionError(f"{path} is no valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(entries, dict):
        raise DescriptionError(
            f"{path} holds no table of names and values; expected ROS CameraInfo or an OpenCV or Kalibr file"
        )
    return {str(key): value for key, value in entries.items()}


def _refuse_references(text: str) -> None:
    """Raise ValueError if values are aliases, which a short file can multiply without limit, or nested too deep."""
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("it refers to values by name (*name), which this program does not read")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_DEPTH:
            raise ValueError(f"it is nested more than {MOST_DEPTH} deep")


def _simplify_name(name: object) -> str:
    """Return the last part of a dotted name in lower case without separators."""
    return re.sub("[^a-z0-9]", "", str(name).rpartition(".")[2].lower())


def _is_equidistant(entries: dict[str, object], path: Path) -> bool:
    """Return True if an entry, also in nested tables, states the model of `cv2.fisheye`.

    Raises DescriptionError if one states a lens model that the sensor does not have.
    """
    stated: dict[bool, str] = {}
    for key, value in _list_values(entries):
        name, model, entry = _simplify_name(key), _simplify_name(value), f"{key}: {shorten(str(value))}"
        foreign = model not in (*_BROWN_CONRADY, *_PINHOLES, *_EQUIDISTANT)
        equidistant = name in (*_MODELS, *_MAYBE_MODELS) and model in _EQUIDISTANT
        if name in _MODELS:
            refused = foreign and value is not None
        elif name in _MAYBE_MODELS:
            refused = foreign and _FOREIGN.search(model) is not None
        else:
            # OpenCV writes xi for its omnidirectional model, and fisheye_model: 1 for the equidistant one.
            refused = name == "xi" and str(value).lower() not in _NO
            equidistant = "fisheye" in name and str(value).lower() not in _NO
        if refused:
            raise DescriptionError(
                f"{path} has another lens model, {entry}; this program's camera is a pinhole with k1, k2, p1, p2, k3 "
                "(plumb_bob), with k4, k5, k6 as well (rational_polynomial), or with k1 to k4 of an equidistant lens "
                "(fisheye): calibrate with one of these"
            )
        if equidistant or (name in _MODELS and model and model in _BROWN_CONRADY):
            stated.setdefault(equidistant, entry)
    if len(stated) > 1:
        raise DescriptionError(
            f"{path} states two lens models, {' and '.join(stated.values())}; expected one: remove the wrong one"
        )
    return True in stated


def _list_values(value: object) -> Iterator[tuple[str, object]]:
    """Yield the names and values of all tables, outer ones first; tables and lists of tables are searched."""
    if isinstance(value, dict):
        yield from ((str(key), each) for key, each in value.items() if not isinstance(each, dict | list))
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for each in inner:
        if isinstance(each, dict | list):
            yield from _list_values(each)


def _unpack_kalibr(known: dict[str, object], path: Path) -> dict[str, object]:
    """Return the entries of the only camera of a Kalibr file as those of a CameraInfo; other files unchanged."""
    cameras = {name: each for name, each in known.items() if isinstance(each, dict) and "intrinsics" in each}
    if not cameras:
        return known
    if len(cameras) > 1:
        raise DescriptionError(
            f"{path} has {len(cameras)} cameras ({shorten(', '.join(cameras))}); expected one: give a file with only "
            "the camera of the sensor"
        )
    camera = {_simplify_name(key): value for key, value in next(iter(cameras.values())).items()}
    numbers = _list_numbers(camera, ("intrinsics",), path).tolist()
    if len(numbers) != 4:
        raise DescriptionError(f"{path}: there are {len(numbers)} intrinsics; expected fx, fy, cx, cy of a pinhole")
    fx, fy, cx, cy = numbers
    camera["cameramatrix"] = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    if isinstance(size := camera.get("resolution"), list) and len(size) == 2:
        camera["imagewidth"], camera["imageheight"] = size
    return camera


def _list_numbers(known: dict[str, object], names: tuple[str, ...], path: Path) -> np.ndarray:
    """Return the finite numbers (N,) of a matrix in any of its notations."""
    value = next((known[name] for name in names if known.get(name) is not None), None)
    value = value.get("data") if isinstance(value, dict) else value
    if value is None:
        raise DescriptionError(
            f"{path} has none of {', '.join(names)} (in any case, with or without underscores); it has "
            f"{shorten(', '.join(known)) or 'nothing'}"
        )
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise DescriptionError(f"{path}: {names[0]} is {shorten(repr(value))}; expected numbers") from error
    if not (np.abs(numbers) < _LARGEST).all():
        found = shorten(str(numbers.tolist()))
        raise DescriptionError(f"{path}: {names[0]} holds {found}; expected finite numbers below {_LARGEST:g}")
    return numbers


def _make_distortion(coefficients: np.ndarray, path: Path) -> Distortion:
    """Return k1, k2, p1, p2, k3, k4, k5, k6; further coefficients of OpenCV's longer models must be zero."""
    if len(coefficients) not in (0, 4, 5, 8, 12, 14):
        raise DescriptionError(f"{path}: there are {len(coefficients)} distortion coefficients; expected 4, 5 or 8")
    known = dict(zip(Distortion.model_fields, coefficients.tolist(), strict=False))
    if np.any(coefficients[len(known) :]):
        raise DescriptionError(
            f"{path}: the distortion has {len(coefficients)} coefficients (thin prism or tilted sensor); this "
            "program's camera has k1, k2, p1, p2, k3, k4, k5, k6: calibrate with one of the models plumb_bob and "
            "rational_polynomial"
        )
    return validate_description(Distortion, known, path)


def _read_size(known: dict[str, object], path: Path) -> tuple[int, int] | None:
    sides = ((known.get(f"image{side}"), known.get(side)) for side in ("width", "height"))
    size = [given if given is not None else other for given, other in sides]
    if None in size:
        return None
    try:
        width_px, height_px = (int(float(str(each))) for each in size)
    except (TypeError, ValueError, OverflowError) as error:
        found = shorten(" x ".join(map(repr, size)))
        raise DescriptionError(f"{path}: the image size is {found}; expected whole numbers") from error
    return width_px, height_px


def _read_region(known: dict[str, object], path: Path) -> list[int]:
    """Return column, row, width and height of a CameraInfo's region; empty for the whole image sensor.

    Raises DescriptionError if pixels are binned.
    """
    if any(str(known.get(f"binning{axis}", 0)) not in ("0", "1") for axis in "xy"):
        raise DescriptionError(f"{path} is for binned pixels: give the intrinsics of the images that are used")
    roi = known.get("roi")
    names = ("xoffset", "yoffset", "width", "height")
    stated = {_simplify_name(key): value for key, value in roi.items()} if isinstance(roi, dict) else {}
    try:
        region = [int(str(stated.get(name) or 0)) for name in names]
    except ValueError as error:
        raise DescriptionError(f"{path}: the region (roi) is {shorten(str(roi))}; expected whole numbers") from error
    if any(region) and not (min(region[:2]) >= 0 and min(region[2:]) > 0):
        raise DescriptionError(f"{path}: the region (roi) is {shorten(str(roi))}; expected its offsets and its size")
    return region if any(region) else []


_WIDEST = np.radians(89.0)
"""Largest angle to the axis that is tried: at 90 deg the tangent, the radius of the rational model, is infinite."""
_BEYOND = 1.02
"""Fitted radius in the image, in radii of the corner: points just outside the image are projected as well."""
_SAMPLES = 500
"""Angles of the fit: fifty for each of its numbers."""
_LARGEST_MISS_PX = 0.02
"""Largest difference of both models in the image, less than half the error of a good corner. For f = 436 px, lenses
with k = 0 and with three sets of coefficients of real size differ by 0.003 px up to 70 deg. The difference is 0.02 px
at 75 deg, and 0.1 px at 80 deg."""


def convert_equidistant(coefficients: np.ndarray, *, corner: float, focal_px: float, source: str) -> Distortion:
    """Return the rational distortion of a lens with the model of `cv2.fisheye`, up to the image's corner.

    The equidistant model has the image radius a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) at the angle a to the axis (J.
    Kannala and S. S. Brandt, PAMI 28 (2006), 1335). The rational one is a function of tan a. Its six coefficients are
    fitted by linear least squares, weighted with the denominator of the previous pass.

    ``coefficients`` are k1 to k4. ``corner`` is the distance of the image's farthest corner from the principal point,
    in focal lengths; ``source`` names the file in messages.

    Raises DescriptionError if the lens does not image the corner, or its angle is too wide for the rational model.
    """
    angle = np.linspace(0.0, _WIDEST, 50 * _SAMPLES)
    radius = _compute_image_radius(coefficients, angle)
    falls = np.flatnonzero(np.diff(radius) <= 0)
    end = falls[0] if len(falls) else len(angle) - 1
    if radius[end] < corner:
        raise DescriptionError(
            f"{source}: its equidistant lens images angles up to {np.degrees(angle[end]):.0f} deg, and the image's "
            f"corners are further out ({corner:.2f} focal lengths from the principal point, the angle is at "
            f"{radius[end]:.2f}); this program's camera needs rays for the whole image: cut the images, or check the "
            "coefficients"
        )
    reach = np.interp(min(_BEYOND * corner, radius[end]), radius[: end + 1], angle[: end + 1])
    angle = np.linspace(0.0, reach, _SAMPLES + 1)[1:]
    seen, r = _compute_image_radius(coefficients, angle), np.tan(angle)
    powers = np.stack([r**2, r**4, r**6], axis=1)
    below, found = np.ones_like(r), np.zeros(6)
    for _ in range(20):  # passes; the weights settle in less than ten
        weight = r / below
        terms = np.hstack([powers, -powers * (seen / r)[:, None]]) * weight[:, None]
        scale = np.linalg.norm(terms, axis=0)
        found = np.linalg.lstsq(terms / scale, (seen / r - 1.0) * weight, rcond=1e-14)[0] / scale
        below = 1.0 + powers @ found[3:]
        if not (below > 0).all():
            break
    fitted = r * (1.0 + powers @ found[:3]) / below
    miss = focal_px * float(np.abs(fitted - seen)[seen <= corner].max())
    if not (miss <= _LARGEST_MISS_PX and (below > 0).all() and (np.diff(fitted) > 0).all()):
        widest = np.degrees(angle[seen <= corner][-1])
        raise DescriptionError(
            f"{source}: its equidistant lens sees the image's corners at {widest:.0f} deg from the axis; "
            f"this program's camera (rational_polynomial) departs from it by {miss:.2g} px, at most "
            f"{_LARGEST_MISS_PX} px are allowed, as up to about 70 deg: cut the images, or calibrate with "
            "rational_polynomial"
        )
    return Distortion(**{f"k{number}": value for number, value in enumerate(found.tolist(), 1)})


def _compute_image_radius(coefficients: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the image radius (N,) in focal lengths at angles (N,) to the axis, rad."""
    return angle * (1.0 + sum(k * angle ** (2 * n) for n, k in enumerate(coefficients.tolist(), 1)))
