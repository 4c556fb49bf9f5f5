"""Comparison of a campaign's deviations with the uncertainties that its sensor states, before anything is rendered."""

import math
from collections.abc import Iterator, Sequence

from pydantic import BaseModel

from twin.scene.campaign import Campaign, Take, choose_sensors
from uwlts.model.artefacts import StepStandard, parse_artefact
from uwlts.model.sensor import Sensor

_NORMAL = 1.96
"""Half width that contains 95 % of normal deviations (unit: standard deviation)."""
_UNIFORM = 0.95
"""The same for uniform deviations (unit: half width of their distribution)."""
_DIFFERENCE = 2.0 * (1.0 - math.sqrt(0.05))
"""The same for the difference of two independent uniform deviations, whose distribution is a triangle."""


class Understated(BaseModel, frozen=True):
    """Deviation of a campaign that is larger than stated, so that stated uncertainties of measurements are too small.

    Attributes
    ----------
    quantity, unit : str
        What deviates.
    key : str
        Key of the statement in the sensor's table ``[uncertainty]``, or in the artefact of a scene.
    deviation : float
        Half width that contains 95 % of the campaign's deviations, plus the deviation of the sensor as built.
    expanded : float
        Stated expanded uncertainty (k = 2).
    """

    quantity: str
    unit: str
    key: str
    deviation: float
    expanded: float

    def text(self) -> str:
        """Return the deviation and the statement as a sentence."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.quantity}: 95 % of the campaign's deviations are within ±{self.deviation:.2g}{unit}, the "
            f"description states ±{self.expanded:.2g}{unit} (`{self.key}`, k = 2)"
        )


def find_understated(campaign: Campaign, takes: Sequence[Take]) -> tuple[Understated, ...]:
    """Return the deviations of a campaign that exceed the uncertainties (k = 2) stated for the sensor.

    ``takes`` are the recordings of one seed. Errors of the lattice, of detected circles, of the camera's focus and of
    the waist's distance have no key: residuals show them, or they change no position.
    """
    described, built = choose_sensors(campaign.sensor, campaign.as_built)
    pairs = (*_of_sensor(campaign, described, built), *_of_stage_and_target(campaign, described))
    found = [*pairs, *_of_media(campaign, takes, built), *_of_steps(campaign, takes)]
    # Stated values are rounded, as 2.9 K for a half width of 5 K.
    return tuple(each for each in dict.fromkeys(found) if each.deviation > 1.02 * each.expanded)


def _of_sensor(campaign: Campaign, described: Sensor, built: Sensor) -> Iterator[Understated]:
    """Yield deviations of windows, laser and lens, those of the sensor as built included."""
    drawn, stated, wavelength = campaign.imperfections, described.uncertainty, described.laser.wavelength_nm
    nominal, real = described.camera.window, built.camera.window
    behind, laser, lens = described.laser.window, built.laser, built.camera.distortion
    thicker = abs(math.log(laser.waist_radius_mm / described.laser.waist_radius_mm))
    turned = max(abs(real.tilt_x_deg - nominal.tilt_x_deg), abs(real.tilt_y_deg - nominal.tilt_y_deg))
    tangential = max(abs(lens.p1 - described.camera.distortion.p1), abs(lens.p2 - described.camera.distortion.p2))
    rows: tuple[tuple[str, str, float, float], ...] = (
        ("distance of the camera's window", "window_distance_mm", real.distance_mm - nominal.distance_mm, 0.0),
        ("tilt of the camera's window", "window_tilt_deg", turned, drawn.window_tilt_std_deg),
        (
            "glass thickness of the camera's window",
            "glass_thickness_mm",
            real.thickness_mm - nominal.thickness_mm,
            drawn.glass_thickness_std_mm,
        ),
        (
            "glass index of the camera's window",
            "glass_index",
            real.index(wavelength) - nominal.index(wavelength),
            drawn.glass_index_std,
        ),
        # Only a turn about the line changes the direction of the sheet.
        ("tilt of the laser's window", "laser_window_tilt_deg", laser.window.tilt_y_deg - behind.tilt_y_deg, 0.0),
        (
            "tilt of the beam at the line optics",
            "bow_deg",
            laser.bow_deg - described.laser.bow_deg,
            drawn.sheet_bow_std_deg,
        ),
        ("relative thickness of the sheet", "sheet_thickness", thicker, drawn.waist_std),
        ("tangential distortion", "tangential", tangential, 0.0),
    )
    for quantity, key, known, std in rows:
        yield _compare(quantity, key, abs(known) + _NORMAL * std, getattr(stated, key))


def _of_stage_and_target(campaign: Campaign, described: Sensor) -> Iterator[Understated]:
    drawn, stated = campaign.imperfections, described.uncertainty
    # Both turn the travel relative to the target's normal.
    turned = math.hypot(drawn.stage_misalignment_std_deg, drawn.target_tilt_std_deg)
    rows = (
        ("position of the stage", "stage_position_mm", drawn.stage_position_std_mm, stated.stage_position_mm),
        ("scale of the stage", "stage_scale", drawn.stage_lead_std, stated.stage_scale),
        ("direction of the stage", "stage_alignment_deg", turned, stated.stage_alignment_deg),
        ("bow of the target", "target_bow_mm", drawn.target_bow_std_mm, stated.target_bow_mm),
        ("stretch of the target", "target_stretch", drawn.target_stretch_std, min(stated.stretch_by_axis())),
    )
    for quantity, key, std, known in rows:
        yield _compare(quantity, key, _NORMAL * std, known)


def _of_media(campaign: Campaign, takes: Sequence[Take], built: Sensor) -> Iterator[Understated]:
    """Yield deviations of the temperature, for the recorded media whose index follows from it."""
    half = campaign.imperfections.temperature_half_width_c
    for take in takes:
        name, stated = take.scene.medium, take.sensor.uncertainty
        medium = take.sensor.medium(name)
        if medium.index_per_kelvin(take.sensor.laser.wavelength_nm) != 0 and take.built is not take.sensor:
            warmer = abs(built.medium(name).temperature_c - medium.temperature_c)
            both = f"temperature of the {name}"
            yield _compare(both, "temperature_k", warmer + _UNIFORM * half, stated.temperature_k)
            changed = f"{both}, from calibration to measurement"
            yield _compare(changed, "drift_k", _DIFFERENCE * half, stated.drift_k)


def _of_steps(campaign: Campaign, takes: Sequence[Take]) -> Iterator[Understated]:
    """Yield deviations of step standards from their certificates, or from the sensor's statement without one."""
    for take in takes:
        artefact = None if take.scene.artefact is None else parse_artefact(take.scene.artefact)
        if isinstance(artefact, StepStandard):
            certified = artefact.height_uncertainty_mm
            key = "height_uncertainty_mm" if certified else "step_height_mm"
            std = certified / 2 if certified else take.sensor.uncertainty.step_height_mm
            deviation = _UNIFORM * campaign.imperfections.step_height_half_width_mm
            yield _compare("height of the step standard", key, deviation, std)


def _compare(quantity: str, key: str, deviation: float, std: float) -> Understated:
    units = {"mm": "mm", "deg": "deg", "k": "K"}
    unit = units.get(key.rsplit("_", 1)[-1], "")
    return Understated(quantity=quantity, unit=unit, key=key, deviation=deviation, expanded=2 * std)
