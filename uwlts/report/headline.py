"""What the report says first: what was measured with, and the key figures in plain words."""

from typing import Any

from uwlts.report.gather import Campaign, GatheredCapture, Measurement
from uwlts.report.numbers import fixed, is_number, small_length
from uwlts.report.page_toolkit import Tile
from uwlts.report.published import Reference
from uwlts.report.summary_file import summary
from uwlts.report.table import Row

_TILES = {
    "sphere_spacing_error_mm": "Sphere spacing error",
    "probing_error_mm": "Probing error",
    "std_mm": "Standard deviation",
    "step_height_error_mm": "Step height error",
    "pipe_diameter_error_mm": "Pipe diameter error",
    "plane_range_error_mm": "Plane range error",
}

_EXPLANATIONS = {
    "sphere spacing": "Distance between the centres of spheres fitted to the points, each with its radius free "
    "(VDI/VDE 2634: SSE is its error).",
    "probing error PE": "Range of the points' distances from the fitted sphere without stray points, of which "
    "VDI/VDE 2634 allows 0.3 %; of several spheres the worst.",
    "range error RE": "Range of the points' distances from the fitted plane.",
    "deviations STD": "Standard deviation of the points' distances from the fitted surface; of several the largest.",
    "deviations range": "Largest less smallest distance of the points from the fitted surface.",
    "step height": "Mean distance of one tread's points from the plane fitted to the other tread.",
    "pipe diameter": "Diameter of the fitted cylinder.",
    "within": "Share of the points whose distance to the true surface, along its normal, is at most this.",
    "rms distance": "Root mean square of those distances. Only rendered captures have a true surface. A best fit turns "
    "and shifts the whole cloud, as aligning it with a drawing would.",
    "window distance": "From the camera's entrance pupil to the window's inner face, found from the step standard in "
    "water; true is what was set in the twin.",
    "interface distance": "With one refraction a single interface stands for the whole window; its distance has no "
    "true value.",
}
_PUBLISHED = (
    "Published values in mm for the same kind of measurement: errors where there is a calibrated value, else the "
    "quantity itself; several values are several positions."
)


def headline_tiles(campaign: Campaign, reference: Reference | None) -> list[Tile]:
    """The key figures that the campaign has."""
    content = summary(campaign, reference)
    published = content["published"] or {}
    tiles = []
    for key, name in _TILES.items():
        found = content[key]
        count = len(found["by_measurement"])
        if count:
            mean = published.get(key, {}).get("mean_abs")
            note = f"mean absolute value of {count} measurements" if count > 1 else "one measurement"
            covered = len(published.get(key, {}).get("by_measurement", ()))
            theirs = None if mean is None else small_length(mean)
            if theirs and covered < count:
                theirs += f" for {covered} of them"
            tiles.append(Tile(name, small_length(found["mean_abs"]), _with_published(note, reference, theirs)))
    if content["truth"]["share_within_tolerance"] is not None:
        tiles.append(_truth_tile(content["truth"]))
    window = content["window_distance_mm"]
    if window["estimated"] is not None:
        true = "" if window["true"] is None else f"true {fixed(window['true'])} mm"
        values = published.get("window_distance_mm") or []
        theirs = ", ".join(f"{value:g} mm" for value in values)
        note = _with_published(true, reference, theirs)
        tiles.append(Tile("Window distance", f"{fixed(window['estimated'])} mm", note))
    return tiles


def _with_published(note: str, reference: Reference | None, theirs: str | None) -> str:
    return f"{note}\n{reference.title}: {theirs}" if reference is not None and theirs else note


def _truth_tile(truth: dict[str, Any]) -> Tile:
    """Agreement with truth after the best-fit motion where there is one: the datum is the calibration's own choice."""
    best, fitted = truth["after_best_fit"], truth["after_best_fit"]["share_within_tolerance"] is not None
    shown = best if fitted else truth
    note = f"rms distance {small_length(shown['rms_mm'])}"
    if fitted:
        note += f" after a best-fit motion; in the sensor's own coordinates {small_length(truth['rms_mm'])}"
    name = f"Points within {1e3 * truth['tolerance_mm']:g} µm of the truth"
    return Tile(name, f"{100 * shown['share_within_tolerance']:.2f} %", note)


def introduction(campaign: Campaign) -> list[tuple[str, str]]:
    """Sensor, medium, calibration and origin of the images, each in a sentence."""
    recorded = [m.capture for m in campaign.measurements if m.capture is not None] or list(campaign.captures)
    judged = [m.judged for m in campaign.measurements if m.judged is not None]
    facts = []
    if sensors := _once([_sensor(capture) for capture in recorded] or [j.sensor for j in judged if j.sensor]):
        facts.append(("Sensor", "; ".join(sensors)))
    indices = [text for m in campaign.measurements if (text := _index(m)) is not None]
    if media := _once([_medium(capture) for capture in recorded] + indices):
        facts.append(("Medium", "; ".join(media)))
    if origins := _once([_origin(capture) for capture in recorded]):
        facts.append(("Images", "; ".join(origins)))
    calibration = campaign.main_calibration
    if calibration is not None:
        window = calibration.calibration.window
        seen = "no window" if window is None else (
            f"window {fixed(window.distance_mm)} mm from the entrance pupil, "
            + ("glass plate with two refractions" if window.refractions == 2 else "taken as one refracting interface")
        )  # fmt: skip
        source = calibration.calibration.provenance.get("source")
        facts.append(("Calibration", f"{calibration.name}: {seen}" + (f" ({source})" if source else "")))
    return facts


def explanations(rows: list[Row], reference: Reference | None) -> list[tuple[str, str]]:
    """What the quantities of a table mean."""
    found = [
        (start, text) for start, text in _EXPLANATIONS.items() if any(row.quantity.startswith(start) for row in rows)
    ]
    if reference is not None:
        found.append((reference.title, _PUBLISHED))
    return found


def _sensor(capture: GatheredCapture) -> str:
    sensor = capture.header.sensor
    camera = sensor.camera
    return f"{sensor.name}, {camera.width_px} x {camera.height_px} pixels, {sensor.laser.wavelength_nm:g} nm"


def _medium(capture: GatheredCapture) -> str:
    medium = capture.header.medium
    parts = [f"{medium.temperature_c:g} °C"] if medium.kind != "custom" else []
    if medium.kind == "sea":
        parts.append(f"{medium.salinity_g_kg:g} g/kg salt")
    name = capture.header.medium_name
    return ", ".join([name if name == medium.kind else f"{name} ({medium.kind})", *parts])


def _index(measurement: Measurement) -> str | None:
    """The index that the points were calculated with, which need not be the description's."""
    recorded = {} if measurement.cloud is None else measurement.cloud.metadata
    index = measurement.judged.medium_index if measurement.judged is not None else recorded.get("medium_index")
    return f"points calculated with n = {index:.5f} relative to air" if is_number(index) else None


def _origin(capture: GatheredCapture) -> str:
    provenance = capture.header.provenance
    source = provenance.get("source")
    if source == "twin":
        effects = provenance.get("effects")
        return "rendered by the digital twin" + (", sharp and without noise" if effects == [] else "")
    return f"recorded by {source}" if isinstance(source, str) else "of unknown origin"


def _once(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))
