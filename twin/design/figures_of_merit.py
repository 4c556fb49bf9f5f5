"""Figures of merit of many designs by formulas, based on a model of the stripe at points of the sheet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from twin.backend.llvm import prepare_llvm, preserve_threads
from twin.design.sensor_arrays import Follow, SensorArrays, compute_adjustments
from twin.scene.platform_kinds import GRAVITY_M_S2
from twin.sensor.detector import PLANCK_TIMES_LIGHT
from uwlts.optics.design import (
    SAFETY_FACTOR,
    Array,
    ImagePoints,
    SheetGeometry,
    Vector,
    across_mm,
    add_vectors,
    direction_outside,
    dot,
    length_outside_mm,
    pixels_per_mm,
    scale_vector,
    select,
    slopes_per_mm,
    snell_root,
    standoff_mm,
    trace_to_points,
    window_thickness_mm,
)

DEPTHS = 5  # number of evaluated depths, evenly spaced over the part of the measuring volume in the camera's view
PLACES = 7  # number of evaluated points along the stripe at each depth
_LINE_PLACES = 101  # the same where only the ends of the line in view are wanted
_MANY = 200  # least number of designs that is worth the time to compile the formulas
_BLOCK = 1000  # number of designs in a block of the compiled formulas
_BRIGHT_LINES = 2.05
"""Level of automatic exposure in standard deviations of speckle above the mean: 2 % of the lines are brighter."""
_UNMODELLED = 0.02
"""Deviation of a stripe from the fitted Gaussian, relative to its height; it limits the weight of the flanks."""
RENDERED_SCATTERING_DEPTH = 5.0
"""Largest optical depth of scattering at which formulas and rendering agreed, see docs/results/designs.md."""
_FLANK = 4.0
"""Limit of the sum over the stripe's profile in standard deviations; less than 1e-4 of the light is outside."""
_NODES = 16  # number of nodes of the sum on either side
_DIFFRACTION = 0.42
"""Standard deviation of the Gaussian closest to an Airy pattern, divided by wavelength times f-number."""


# --- the stripe -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StripeModel:
    """Stripe on a diffuse plate normal to the laser's axis.

    ``sigma_px`` is the standard deviation of the stripe's image across the stripe, and ``blur_px`` the contribution of
    the lens. ``rate_e_per_ms`` is the rate of photo-electrons of the brightest pixel, and ``background_e_per_ms`` the
    rate because of other light. ``way_mm`` is the length of the light's path in the medium, from laser to camera.
    """

    sigma_px: Array
    blur_px: Array
    rate_e_per_ms: Array
    background_e_per_ms: Array
    way_mm: Array


def model_stripe(
    xp: ModuleType, p: SensorArrays, geometry: SheetGeometry, point: Vector, view: ImagePoints, *, reflectance: float
) -> StripeModel:
    """Model the stripe at points of the sheet.

    Across the sheet, the light is a Gaussian of standard deviation w / 2 with w^2 = w0^2 (1 + ((s - s0) / zR)^2)
    (Siegman, Lasers, Eqs. 17.5 and 17.6). Defocus blurs the image uniformly over a disc. An offset b in the pupil
    shifts the image by b / a - ds/dP b. Here a is the focus distance and ds/dP the derivative of the image with respect
    to the point. In one direction, a pupil of radius R has the standard deviation R / 2. Scattered light is lost.

    ``xp`` is NumPy or Dr.Jit, ``point`` is in the camera frame.
    """
    pose, window, (xa, xb, ya, yb) = geometry.laser, geometry.window, view.jacobian
    across = geometry.across((xa, ya)), geometry.across((xb, yb))
    from_laser = add_vectors(point, scale_vector(pose.origin, -1.0))
    distance = xp.sqrt(dot(from_laser, from_laser))
    rayleigh = math.pi * p.waist_mm * p.waist_mm * p.medium_index / (p.beam_quality * p.wavelength_mm)
    sheet = 0.5 * p.waist_mm * xp.sqrt(1 + ((distance - p.waist_distance_mm) / rayleigh) ** 2)
    # Width on a profile line, for a constant pixel along the stripe.
    by_x, by_y = (pixels_per_mm(view, window, direction) for direction in (pose.normal, pose.fan))
    turned = geometry.across(by_y) * geometry.along(by_x) / geometry.along(by_y)
    thick = abs(geometry.across(by_x) - turned) * sheet

    number = p.working_f_number()
    radius = 0.5 * p.focal_mm / number
    shifts = []
    for axis in range(2):
        unit = tuple(1.0 + 0.0 * radius if k == axis else 0.0 * radius for k in range(3))
        change = slopes_per_mm(view, window, unit)
        shifts.append(sum(a * ((1 / p.focus_mm if k == axis else 0.0) - change[k]) for k, a in enumerate(across)))
    defocus = 0.5 * radius * xp.sqrt(shifts[0] ** 2 + shifts[1] ** 2 + 1e-24)
    diffraction = _DIFFRACTION * p.wavelength_mm * number / p.pixel_mm
    blur = xp.sqrt(defocus * defocus + diffraction * diffraction)
    sigma = xp.sqrt(thick * thick + blur * blur + 1 / 12)

    laser_window = p.laser_window(pose.axis)
    fan = trace_to_points(xp, laser_window, from_laser)
    side = dot(from_laser, pose.fan)
    angle = xp.atan(fan.slope) * side / xp.sqrt(side * side + 1e-18)
    lit = _compute_power(xp, p, angle)
    per_mm = p.power_w * lit / (2 * p.fan_half_rad) / ((1 + fan.slope * fan.slope) * fan.growth_mm)
    back = length_outside_mm(xp, window, view.path)
    way = length_outside_mm(xp, laser_window, fan) + back
    passed = xp.exp(-p.extinction_per_mm * way)
    laser_glass = p.laser_window_faces_pass * xp.exp(-p.laser_window_absorption_per_mm * p.laser_window_thickness_mm)
    on_surface = per_mm / (math.sqrt(2 * math.pi) * sheet) * laser_glass * passed
    a, b = view.slopes
    cosine_squared = 1 / (1 + a * a + b * b)
    lens = math.pi / 4 / (number * number) * cosine_squared * cosine_squared
    camera_glass = p.window_faces_pass * xp.exp(-p.window_absorption_per_mm * p.window_thickness_mm)
    per_radiance = lens * camera_glass / (p.medium_index * p.medium_index)
    pixel_area = p.pixel_mm * p.pixel_mm / p.pixel_aspect
    electrons = 1e-3 * pixel_area * 1e-3 * p.wavelength_mm / PLANCK_TIMES_LIGHT * p.quantum_efficiency
    rate = on_surface * reflectance / math.pi * per_radiance * electrons * thick / sigma
    ambient = p.ambient_w_per_mm2 * reflectance / math.pi * per_radiance * electrons
    ambient = ambient * xp.exp(-p.extinction_per_mm * back)
    return StripeModel(sigma, blur, rate, ambient, way)


def centre_noise_px(xp: ModuleType, p: SensorArrays, stripe: StripeModel, exposure_ms: Array) -> Array:
    """Return the standard uncertainty of the stripe's centre in px, for a fit that weights pixels by their noise.

    With the mean signal m = A exp(-x^2 / 2 s^2), its derivative m' and weights m' / W, the variance of the fit is
    sum(m'^2 V / W^2) / sum(m'^2 / W)^2. V is the variance of a pixel: m + (C m)^2 plus read, dark, background and
    rounding noise. The speckle contrast C includes the correlation between neighbouring pixels.

    W is the variance that the fit assumes. It ignores the correlation and adds a deviation of real profiles from
    Gaussian ones. Without this term, the weight of the dark flanks would grow without limit under pure speckle.
    """
    height = stripe.rate_e_per_ms * exposure_ms
    true, taken = p.centre_contrast(xp, stripe.sigma_px) ** 2 + p.prnu**2, p.pixel_contrast(xp) ** 2 + p.prnu**2
    floor = p.read_noise_e**2 + p.offset_e**2 + p.step_e**2 / 12
    floor = floor + (p.dark_e_per_ms + stripe.background_e_per_ms) * exposure_ms
    information, noise = 0.0 * height, 0.0 * height
    width = _FLANK / _NODES
    for node in range(_NODES):
        t = (node + 0.5) * width
        signal = height * math.exp(-0.5 * t * t)
        weight = 1 / (floor + (_UNMODELLED * height) ** 2 + signal + taken * signal**2)
        slope = t * t * signal * signal
        information = information + slope * weight
        noise = noise + slope * weight * weight * (floor + signal + true * signal**2)
    return xp.sqrt(stripe.sigma_px * noise / (2 * width * information * information + 1e-30))


def exposure_ms(xp: ModuleType, p: SensorArrays, brightest_e_per_ms: Array) -> tuple[Array, Array]:
    """Return the exposure for the wanted level of the brightest light, and the exposure that the sensor uses."""
    level = p.exposure_level * p.full_well_e / (1 + _BRIGHT_LINES * p.pixel_contrast(xp))
    required = level / brightest_e_per_ms
    automatic = xp.minimum(required, p.longest_ms)
    return required, select(xp, xp.isnan(p.exposure_ms), automatic, p.exposure_ms)


def _compute_power(xp: ModuleType, p: SensorArrays, angle: Array) -> Array:
    """Return the power per angle divided by its mean; outside the fan, only tabulated profiles are 0."""
    gauss = xp.exp(-2 * (angle / p.fan_half_rad) ** 2) * 2 / (math.sqrt(math.pi / 2) * math.erf(math.sqrt(2)))
    lit = p.gaussian_fan * gauss + (1 - p.gaussian_fan) * (1 - p.tabulated_fan)
    nodes, powers = p.fan_nodes_rad, p.fan_powers
    if len(nodes) > 1:
        # Linear interpolation of a table as a sum of ramps that start at the nodes.
        total, slope_before = powers[0] + 0.0 * angle, 0.0
        for k in range(len(nodes) - 1):
            slope = (powers[k + 1] - powers[k]) / xp.maximum(nodes[k + 1] - nodes[k], 1e-12)
            total = total + (slope - slope_before) * xp.maximum(angle - nodes[k], 0.0)
            slope_before = slope
        lit = lit + p.tabulated_fan * 2 * p.fan_half_rad * xp.maximum(total, 0.0)
    return lit


# --- the measuring volume ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """Quantities over the measuring volume, as arrays that broadcast with (N, DEPTHS, PLACES).

    ``y_mm`` and ``z_mm`` are coordinates in the sheet about the stand-off. The sigmas are standard uncertainties
    because of the stripe's noise. ``lit`` marks points that the laser illuminates and that are in view along the
    stripe. ``in_view`` marks those that are in view across the stripe, too.
    """

    y_mm: Array
    z_mm: Array
    half_line_mm: Array
    sigma_y_mm: Array
    sigma_z_mm: Array
    depth_per_px_mm: Array
    along_per_px_mm: Array
    centre_px: Array
    stripe_px: Array
    blur_px: Array
    signal_e: Array
    occlusion_rad: Array
    scattering_depth: Array
    lit: Array
    in_view: Array
    exposure_ms: Array
    required_ms: Array


def find_depths_in_view(xp: ModuleType, p: SensorArrays) -> tuple[Array, Array]:
    """Return the ends of the part of the measuring volume in the camera's view, in the middle of the line.

    The depths are measured from the window's outer face.
    """
    outer = p.outer_mm(xp)
    near, far = p.geometry(xp).depths_in_view(xp, outer)
    return xp.maximum(p.near_mm, near - outer), xp.minimum(p.far_mm, far - outer)


def evaluate_field(xp: ModuleType, p: SensorArrays, depth_mm: Array, places: Array, *, reflectance: float) -> Field:
    """Evaluate designs at depths and places along the stripe.

    An error of the stripe's centre on its profile line moves the point as `SheetGeometry.mm_per_pixel` states.

    ``xp`` is NumPy, or Dr.Jit for derivatives. Depths count from the window's outer face; places along the stripe are
    -1 to 1 between its ends.
    """
    geometry = p.geometry(xp)
    pose, window = geometry.laser, geometry.window
    z = (p.outer_mm(xp) + depth_mm - standoff_mm(pose)) / pose.axis[2]
    left, right = geometry.line_ends(xp, z)
    laser_window = p.laser_window(pose.axis)
    from_origin = add_vectors(geometry.point(z), scale_vector(pose.origin, -1.0))
    offset, height = dot(from_origin, pose.fan), dot(from_origin, pose.axis)
    edges = [across_mm(xp, laser_window, height, xp.tan(angle)) - offset for angle in (p.lit_from_rad, p.lit_to_rad)]
    low, high = xp.maximum(left, edges[0]), xp.minimum(right, edges[1])
    half = 0.5 * (high - low)
    y = 0.5 * (high + low) + half * places

    point = geometry.point(z, y)
    view = geometry.project(xp, point)
    along_per_mm = geometry.along(pixels_per_mm(view, window, pose.fan))
    y_per_px, z_per_px = geometry.mm_per_pixel(view)
    stripe = model_stripe(xp, p, geometry, point, view, reflectance=reflectance)
    u = geometry.across((view.x, view.y))
    lit = (half > 0) & (height > laser_window.outer_mm) & xp.isfinite(u)
    inside = lit & (u >= -0.5) & (u <= geometry.across((p.width_px, p.height_px)) - 0.5)
    rate = select(xp, lit, stripe.rate_e_per_ms, 0.0)
    # For derivatives of a single design, all points are in one dimension.
    brightest = xp.max(rate, axis=(1, 2))[:, None, None] if len(rate.shape) == 3 else xp.max(rate)
    brightest = select(xp, brightest > 0, brightest, math.nan)
    required, used = exposure_ms(xp, p, brightest)
    noise = centre_noise_px(xp, p, stripe, used)
    from_laser = direction_outside(
        xp, laser_window, trace_to_points(xp, laser_window, add_vectors(point, scale_vector(pose.origin, -1.0)))
    )
    chord = add_vectors(direction_outside(xp, window, view.path), scale_vector(from_laser, -1.0))  # of unit vectors
    return Field(
        y_mm=y,
        z_mm=z,
        half_line_mm=half,
        sigma_y_mm=noise * abs(y_per_px),
        sigma_z_mm=noise * abs(z_per_px),
        depth_per_px_mm=abs(z_per_px),
        along_per_px_mm=1 / abs(along_per_mm),
        centre_px=noise,
        stripe_px=stripe.sigma_px,
        blur_px=stripe.blur_px,
        signal_e=stripe.rate_e_per_ms * used,
        occlusion_rad=2 * xp.asin(xp.minimum(0.5 * xp.sqrt(dot(chord, chord) + 1e-24), 1.0)),
        scattering_depth=p.scattering_per_mm * stripe.way_mm,
        lit=lit,
        in_view=inside,
        exposure_ms=used,
        required_ms=required,
    )


def _label(text: str, unit: str = "mm") -> Any:
    """Return a field of `Figures` with its label and unit for pages."""
    return field(metadata={"words": text, "unit": unit})


@dataclass(frozen=True)
class Figures:
    """Figures of merit of N designs, one array (N,) each.

    Depths are measured along the camera's axis from the window's outer face. Z runs along the laser's axis, Y along the
    stripe, and X across the sheet, along the stage.

    Sigmas are standard uncertainties. They refer to the part of the measuring volume in the camera's view: the largest
    value in it, the root mean square over it (``sigma_z_rms_mm``), and the values at its near end, middle and far end.
    Sigma X follows from the stage's resolution, the others from the stripe's noise. Values per pixel belong to the
    middle of the volume.
    """

    sigma_x_mm: np.ndarray = _label("σ X, by the stage")
    sigma_y_mm: np.ndarray = _label("σ Y, largest in the volume")
    sigma_z_mm: np.ndarray = _label("σ Z, largest in the volume")
    sigma_z_rms_mm: np.ndarray = _label("σ Z, rms over the volume")
    sigma_z_near_mm: np.ndarray = _label("σ Z at the near end")  # root mean squares along the stripe
    sigma_z_middle_mm: np.ndarray = _label("σ Z in the middle")
    sigma_z_far_mm: np.ndarray = _label("σ Z at the far end")
    depth_per_px_mm: np.ndarray = _label("depth per pixel", "mm/px")
    along_per_px_mm: np.ndarray = _label("length along the stripe per pixel", "mm/px")
    coverage: np.ndarray = _label("fraction of the volume in reach", "")  # of camera and laser
    standoff_mm: np.ndarray = _label("stand-off")  # where the sheet crosses the camera's axis
    near_mm: np.ndarray = _label("near end of the volume")
    far_mm: np.ndarray = _label("far end of the volume")
    depth_mm: np.ndarray = _label("depth of the volume")
    line_near_mm: np.ndarray = _label("line length at the near end")
    line_mm: np.ndarray = _label("line length in the middle")
    line_far_mm: np.ndarray = _label("line length at the far end")
    section_cm2: np.ndarray = _label("area of the sheet in the volume", "cm²")  # that the camera sees
    # Largest angle between laser's and camera's rays: steeper walls hide one from the other.
    occlusion_deg: np.ndarray = _label("occlusion angle, largest", "°")
    # Scattering coefficient times the path from laser to camera: mean number of scatterings of the light.
    scattering_depth: np.ndarray = _label("optical depth of scattering, largest", "")
    signal_e: np.ndarray = _label("faintest signal", "e⁻")
    exposure_ms: np.ndarray = _label("exposure", "ms")  # as used
    required_ms: np.ndarray = _label("exposure required", "ms")  # that the wanted brightness takes
    stripe_px: np.ndarray = _label("width of the stripe's image (σ)", "px")  # largest in the volume, as the next two
    blur_px: np.ndarray = _label("the lens's blur (σ)", "px")
    centre_px: np.ndarray = _label("σ of the stripe's centre", "px")
    speckle_limit_mm: np.ndarray = _label("speckle limit of Z")  # Dorsch's, in the middle, for depolarised light
    laser_class: np.ndarray = _label("laser class", "")  # number after IEC 60825-1, see `CLASS_NAMES`, `laser_class`
    window_mm: np.ndarray = _label("window thickness needed")  # for the pressure at the study's depth
    window_safety: np.ndarray = _label("safety factor of the windows", "")  # of the weaker one, at the study's depth
    baseline_mm: np.ndarray = _label("width of the sensor")


FIGURES: dict[str, tuple[str, str]] = {
    one.name: (one.metadata["words"], one.metadata["unit"]) for one in fields(Figures)
}
"""Label and unit of each figure of merit, by name."""


def evaluate_sheet(p: SensorArrays, z_mm: np.ndarray, *, places: int, reflectance: float) -> Field:
    """Return the `Field` (1, K, places) of one design at ``z_mm`` (K,) from the stand-off, along the whole stripe."""
    with np.errstate(all="ignore"):
        pose = p.pose(np)
        depth = standoff_mm(pose) - p.outer_mm(np) + pose.axis[2] * z_mm.reshape(1, -1, 1)
        along = np.linspace(-1, 1, places).reshape(1, 1, -1) * (1 - 1e-9)
        return evaluate_field(np, p, depth, along, reflectance=reflectance)


def find_line_ends(p: SensorArrays, z_mm: np.ndarray) -> np.ndarray:
    """Return the ends (K, 2) along Y of the line that laser and camera of one design reach at ``z_mm`` (K,).

    They are infinite, the first one above the second one, where there is no such line. ``z_mm`` counts from the
    stand-off.
    """
    f = evaluate_sheet(p, z_mm, places=_LINE_PLACES, reflectance=0.5)
    ends = np.where(f.in_view, f.y_mm, np.inf).min(axis=2), np.where(f.in_view, f.y_mm, -np.inf).max(axis=2)
    return np.concatenate(ends).T


def predict_scatter(p: SensorArrays, z_mm: np.ndarray, half_line_mm: np.ndarray, *, reflectance: float) -> np.ndarray:
    """Return the root mean square of sigma Z (K,) along the stripe of one design at ``z_mm`` (K,) from the stand-off.

    The stripe is evaluated up to ``half_line_mm`` (K,) on both sides, within the view.
    """
    f = evaluate_sheet(p, z_mm, places=2 * PLACES + 1, reflectance=reflectance)
    counts = f.in_view & (np.abs(f.y_mm) <= half_line_mm.reshape(1, -1, 1) + 1e-9)
    squares = np.where(counts, f.sigma_z_mm**2, 0.0)
    return np.sqrt(squares.sum(axis=2) / np.maximum(counts.sum(axis=2), 1))[0]


def compute_figures(
    p: SensorArrays, *, reflectance: float, water_depth_m: float, follow: Sequence[Follow] = ()
) -> tuple[Figures, list[str]]:
    """Return the figures of N designs, and for each the reason why it cannot work ("" if it works).

    The figures of a design that cannot work are not meaningful.
    """
    with np.errstate(all="ignore"):
        if p.baseline_mm.size < _MANY:
            found = evaluate_volume(np, p, tuple(follow), reflectance, DEPTH_SHARES, LINE_SHARES)
        else:
            found = _evaluate_compiled(p, tuple(follow), reflectance)
        followers, near, far, field = found
        p, f = replace(p, **followers), Field(**field)
        shape = np.broadcast_shapes(f.sigma_z_mm.shape, (p.near_mm.size, DEPTHS, PLACES))
        full = {name: np.broadcast_to(np.asarray(values, dtype=float), shape) for name, values in vars(f).items()}
        figures = _reduce_fields(p, full, (far - near) / (p.far_mm - p.near_mm), water_depth_m=water_depth_m)
        reasons = _find_reasons(p, figures, full)
    return figures, reasons


DEPTH_SHARES = np.linspace(0, 1, DEPTHS).reshape(1, -1, 1)  # of the depth in view
LINE_SHARES = np.linspace(-1, 1, PLACES).reshape(1, 1, -1) * (1 - 1e-9)
"""Places along the stripe, relative to its half length, just within its ends."""


def evaluate_volume(
    xp: ModuleType, p: SensorArrays, follow: tuple[Follow, ...], reflectance: float, shares: Array, places: Array
) -> tuple[dict[str, Array], Array, Array, dict[str, Array]]:
    """Return the adjusted parameters by name, the near and far ends of the volume in view, and its `Field` by name."""
    followers = compute_adjustments(xp, p, follow)
    p = replace(p, **followers)
    near, far = find_depths_in_view(xp, p)
    field = evaluate_field(xp, p, near + (far - near) * shares, places, reflectance=reflectance)
    return followers, near, far, vars(field)


def _evaluate_compiled(
    p: SensorArrays, follow: tuple[Follow, ...], reflectance: float
) -> tuple[dict[str, Array], Array, Array, dict[str, Array]]:
    """Evaluate `evaluate_volume` with Dr.Jit in a fifth of the time, for two or more designs.

    It uses one thread, because sweeps have one process per core. A recording of Dr.Jit is valid for one number of
    designs only. Therefore the designs are split into blocks of equal size; the last block repeats the last design.
    """
    prepare_llvm()
    import drjit as dr
    from drjit.llvm import TensorXf64

    def converted(values: Array) -> Array:
        return tuple(map(converted, values)) if isinstance(values, tuple) else TensorXf64(_align(values))

    designs = p.baseline_mm.size
    evaluate, at = _freeze(follow, reflectance), (converted(DEPTH_SHARES), converted(LINE_SHARES))
    blocks: list[tuple[dict[str, Array], ...]] = []
    with preserve_threads():
        dr.set_thread_count(1)
        for first in range(0, designs, _BLOCK):
            block = p.select(np.minimum(np.arange(first, first + _BLOCK), designs - 1))
            followers, near, far, field = evaluate({n: converted(values) for n, values in vars(block).items()}, *at)
            tables = followers, {"near": near, "far": far}, field
            blocks.append(tuple({name: array.numpy() for name, array in table.items()} for table in tables))
    followers, ends, field = (
        {name: np.concatenate([table[name] for table in parts])[:designs] for name in parts[0]}
        for parts in zip(*blocks, strict=True)
    )
    return followers, ends["near"], ends["far"], field


def _align(values: np.ndarray) -> np.ndarray:
    """Return a copy aligned to 64 bytes; Dr.Jit would compile kernels again for each other alignment of its arrays."""
    room = np.empty(values.size + 8)
    first = -room.ctypes.data % 64 // 8
    copy = room[first : first + values.size].reshape(values.shape)
    copy[...] = values
    return copy


@cache
def _freeze(follow: tuple[Follow, ...], reflectance: float) -> Callable[..., Any]:
    """Return `evaluate_volume` as a function that Dr.Jit records at the first call and replays for other values."""
    import drjit as dr

    return dr.freeze(lambda given, *at: evaluate_volume(dr, SensorArrays(**given), follow, reflectance, *at))


def _reduce_fields(p: SensorArrays, f: dict[str, np.ndarray], share: np.ndarray, *, water_depth_m: float) -> Figures:
    """Return the figures of N designs from their fields (N, DEPTHS, PLACES) and the fraction of the depth in view."""
    n, middle, inside = len(f["z_mm"]), DEPTHS // 2, f["lit"] > 0
    one = p.each

    def worst(name: str) -> np.ndarray:
        return np.where(inside, f[name], -np.inf).max(axis=(1, 2))

    def rms(values: np.ndarray, where: np.ndarray) -> np.ndarray:
        return np.sqrt(np.where(where, values**2, 0.0).sum(axis=-1) / where.sum(axis=-1))

    per_depth = rms(f["sigma_z_mm"], inside)
    line = np.where(inside.any(axis=2), 2 * f["half_line_mm"][:, :, 0], 0.0)
    at, pose = (slice(None), middle, PLACES // 2), p.pose(np)
    needed = windows_needed_mm(p, water_depth_m=water_depth_m)
    shares = [t / least for t, least in zip((p.window_thickness_mm, p.laser_window_thickness_mm), needed, strict=True)]
    speckle_px = p.speckle_coherence / math.sqrt(2) * p.wavelength_mm * p.working_f_number() / math.pi / p.pixel_mm
    return Figures(
        **{name: worst(name) for name in ("sigma_y_mm", "sigma_z_mm", "stripe_px", "blur_px", "centre_px")},
        **{name: f[name][at] for name in ("depth_per_px_mm", "along_per_px_mm")},
        **{name: f[name][:, 0, 0] for name in ("exposure_ms", "required_ms")},
        sigma_x_mm=one(p.stage_resolution_mm / math.sqrt(12)),
        sigma_z_rms_mm=rms(f["sigma_z_mm"].reshape(n, -1), inside.reshape(n, -1)),
        sigma_z_near_mm=per_depth[:, 0],
        sigma_z_middle_mm=per_depth[:, middle],
        sigma_z_far_mm=per_depth[:, -1],
        coverage=one(np.maximum(share, 0.0)) * inside.mean(axis=(1, 2)),
        standoff_mm=one(standoff_mm(pose) - p.outer_mm(np)),
        near_mm=one(p.near_mm),
        far_mm=one(p.far_mm),
        depth_mm=one(p.far_mm - p.near_mm),
        line_near_mm=line[:, 0],
        line_mm=line[:, middle],
        line_far_mm=line[:, -1],
        section_cm2=0.01 * np.trapezoid(line, f["z_mm"][:, :, 0], axis=1),
        occlusion_deg=np.degrees(worst("occlusion_rad")),
        scattering_depth=worst("scattering_depth"),
        signal_e=np.where(inside, f["signal_e"], np.inf).min(axis=(1, 2)),
        speckle_limit_mm=one(speckle_px) * f["depth_per_px_mm"][at],
        laser_class=one(laser_class(p)),
        window_mm=one(needed[0]),
        window_safety=one(SAFETY_FACTOR * np.minimum(*shares) ** 2),
        baseline_mm=one(np.hypot(*pose.origin[:2])),
    )


def _find_reasons(p: SensorArrays, figures: Figures, f: dict[str, np.ndarray]) -> list[str]:
    """Return for each of N designs the first reason why it cannot work, "" if it works."""
    one = p.each
    corner = np.hypot(p.width_px, p.height_px / p.pixel_aspect) / 2 * p.pixel_mm / p.focal_mm
    glass = corner / snell_root(np, p.window_index, corner)
    cone = one(2 * (corner * p.window_distance_mm + p.window_thickness_mm * glass) + p.focal_mm / p.f_number)
    spread = np.tan(p.fan_half_rad)
    inside = spread / snell_root(np, p.laser_window_index, spread)
    fan = one(2 * (spread * p.laser_window_distance_mm + inside * p.laser_window_thickness_mm))
    fullest = np.where(f["lit"] > 0, f["signal_e"], 0.0).max(axis=(1, 2)) / one(p.full_well_e)
    numbers = {
        "crossing": -figures.standoff_mm,
        "begins": -figures.near_mm,
        "cone": cone,
        "fan": fan,
        "fullest": fullest,
    }
    flat = np.fmax(figures.depth_per_px_mm, figures.along_per_px_mm)
    checks = {
        "the focus distance is not larger than the focal length": one(p.focus_mm - p.focal_mm) <= 0,
        "the sheet crosses the camera's axis {crossing:.0f} mm behind the window's outer face, not in front of it": (
            ~(figures.standoff_mm > 0) | ~(figures.standoff_mm < 1e5)
        ),
        "the measuring volume would begin {begins:.0f} mm behind the window's outer face": ~(figures.near_mm > 0),
        "the cone of view is {cone:.0f} mm wide at the window's outer face, wider than the aperture": (
            cone > one(p.window_aperture_mm)
        ),
        "the laser's fan is {fan:.0f} mm wide at its window, wider than the aperture": (
            fan > one(p.laser_window_aperture_mm)
        ),
        "camera and laser reach no point of the measuring volume": ~(figures.coverage > 0),
        "the stripe saturates: at the given exposure it has {fullest:.1f} times the full well": fullest > 1,
        "the stripe's image is nearly independent of depth, or runs along the other side of the image: "
        "turn the camera or the laser": (~(flat < 0.5 * figures.standoff_mm)),
    }
    reasons = [""] * len(figures.coverage)
    for text, failed in checks.items():
        for i in np.flatnonzero(failed):
            reasons[i] = reasons[i] or text.format(**{name: values[i] for name, values in numbers.items()})
    return reasons


CLASS_NAMES = {1: "1", 2: "2", 3: "3R", 4: "3B", 5: "4"}
# IEC 60825-1:2014, condition 3 and Tables 3 to 8.
_PUPIL_MM = 7.0
_AWAY_MM = 100.0
_CLASS_2_W = 1e-3
_CLASS_3R_W = 5e-3
_CLASS_3B_W = 0.5

_WATER_KG_PER_M3 = 1030.0  # density of sea water


def laser_class(p: SensorArrays) -> np.ndarray:
    """Estimate the laser class after IEC 60825-1:2014 as a number, see `CLASS_NAMES`; this is not a classification.

    The limits are those for continuous visible light from a point source (Tables 3 to 8). Class 1 extends to 0.39 mW
    above 500 nm, to 0.039 mW below 450 nm, and to 0.039 mW times C3 = 10^(0.02 (nm - 450)) in between. Class 2 extends
    to 1 mW, 3R to 5 mW, and 3B to 500 mW. The limits apply to the power through an aperture of 7 mm at 100 mm from the
    line optics in air (condition 3). The aperture is at the angle with the highest power. Each laser is classified
    separately.
    """
    seen = 2 * math.atan(0.5 * _PUPIL_MM / _AWAY_MM) / (2 * p.fan_half_rad)
    gaussian = 2 / (math.sqrt(math.pi / 2) * math.erf(math.sqrt(2)))
    tabulated = 2 * p.fan_half_rad * np.maximum.reduce(p.fan_powers)
    peak = np.where(p.gaussian_fan > 0, gaussian, np.where(p.tabulated_fan > 0, tabulated, 1.0))
    power = p.power_w * np.minimum(1.0, peak * seen)
    nm = 1e6 * p.wavelength_mm
    class_1 = 3.9e-5 * 10 ** (0.02 * (np.clip(nm, 450, 500) - 450))
    limits = (class_1, _CLASS_2_W, _CLASS_3R_W, _CLASS_3B_W)
    return np.sum([power > limit for limit in limits], axis=0) + 1


def windows_needed_mm(p: SensorArrays, *, water_depth_m: float) -> list[np.ndarray]:
    """Return the thicknesses of the clamped round windows of camera and laser.

    The strength is that of the named glass, or of fused silica if it is unknown.
    """
    pressure_mpa = 1e-6 * GRAVITY_M_S2 * _WATER_KG_PER_M3 * water_depth_m
    windows = (p.window_aperture_mm, p.window_strength_mpa), (p.laser_window_aperture_mm, p.laser_window_strength_mpa)
    return [
        window_thickness_mm(
            pressure_mpa=pressure_mpa,
            unsupported_diameter_mm=np.where(np.isfinite(aperture), aperture, 0.0),
            strength_mpa=strength,
        )
        for aperture, strength in windows
    ]
