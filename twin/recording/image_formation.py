"""Formation of images by lens and detector: from the light before the lens to photo-electrons and grey values."""

from typing import TypeAlias

import numpy as np

from twin.light.renderer import LaserFrame
from twin.rendering_options import Options
from twin.scene.platforms import Shot
from twin.sensor.detector import (
    add_ghost,
    add_glare,
    deliver_image,
    dirt,
    electrons_per_ms,
    fixed_pattern,
    grey_values,
    laser_shares,
    vignette,
)
from twin.sensor.speckle import Speckle, coherence
from uwlts.model.sensor import Medium, Sensor

ShotLight: TypeAlias = tuple[np.ndarray, LaserFrame | None]
"""Irradiance (H, W) of lamp and daylight before the lens in W/mm2, and the laser's light, None if it is off."""


class ImageFormation:
    """Lens and detector of a sensor in a medium, with the effects and flaws of ``options``."""

    def __init__(self, sensor: Sensor, medium: Medium, options: Options, *, window_mounted: bool):
        self._sensor, self._medium, self._options = sensor, medium, options
        camera, flaws = sensor.camera, options.flaws
        self._speckle = Speckle(camera, wavelength_nm=sensor.laser.wavelength_nm, seed=options.seed)
        # None without losses: each multiplication of an image takes a millisecond.
        self._passed = vignette(camera, flaws.vignetting) if flaws.vignetting else None
        if flaws.dirt and window_mounted:
            clean = dirt(camera, flaws.dirt, seed=options.seed)
            self._passed = clean if self._passed is None else self._passed * clean
        self._laser_shares = laser_shares(camera.height_px, camera.width_px) if flaws.colour_filter else None
        self._pattern = None
        if options.effects.fixed_pattern:
            self._pattern = fixed_pattern(sensor.detector, height=camera.height_px, width=camera.width_px)

    def electrons_per_ms(self, light: ShotLight, shot: Shot, *, speckle: bool = True) -> np.ndarray:
        """Return mean photo-electrons per ms (H, W) of a shot's light, with ``speckle`` if it is enabled."""
        even, laser = light
        passed = self._apply_lens(even)
        if laser is not None:
            seen = self._apply_lens(self._add_speckle(laser, shot) if speckle else laser.irradiance())
            passed = passed + (seen if self._laser_shares is None else self._laser_shares * seen)
        return self._convert_to_electrons(passed)

    def electrons_of_part(self, irradiance: np.ndarray, *, of_laser: bool) -> np.ndarray:
        """Return mean photo-electrons per ms (H, W) of one light path alone, without speckle."""
        passed = self._apply_lens(irradiance)
        if of_laser and self._laser_shares is not None:
            passed = self._laser_shares * passed
        return self._convert_to_electrons(passed)

    def detect(self, electrons: np.ndarray, *, exposure_ms: float, noise_seed: list[int]) -> np.ndarray:
        """Return grey values (H, W) for mean photo-electrons (H, W), with seeded noise if noise is enabled."""
        rng = np.random.default_rng(noise_seed) if self._options.effects.noise else None
        image = grey_values(
            electrons,
            self._sensor.detector,
            exposure_ms=exposure_ms,
            rng=rng,
            pattern=self._pattern,
            row_noise_e=self._options.flaws.row_noise,
        )
        return deliver_image(image, self._options.flaws)

    def _convert_to_electrons(self, irradiance: np.ndarray) -> np.ndarray:
        sensor = self._sensor
        return electrons_per_ms(irradiance, sensor.camera, sensor.detector, wavelength_nm=sensor.laser.wavelength_nm)

    def _apply_lens(self, irradiance: np.ndarray) -> np.ndarray:
        """Return the irradiance (H, W) behind the lens, with vignetting, ghost and glare."""
        passed, flaws = irradiance if self._passed is None else irradiance * self._passed, self._options.flaws
        passed = add_ghost(passed, self._sensor.camera, flaws.ghost) if flaws.ghost else passed
        return add_glare(passed, flaws.glare) if flaws.glare else passed

    def _add_speckle(self, frame: LaserFrame, shot: Shot) -> np.ndarray:
        """Return the irradiance (H, W) of the laser in W/mm2, with speckle."""
        if not self._options.effects.speckle:
            return frame.irradiance()
        laser = self._sensor.laser
        contrast = coherence(
            frame.roughness_um,
            linewidth_nm=laser.linewidth_nm,
            wavelength_nm=laser.wavelength_nm,
            index=self._medium.refractive_index(laser.wavelength_nm),
        )
        factors = self._speckle.factors(
            frame.rows, frame.columns, travel_mm=shot.travelled_mm, polarisation=frame.polarisation, coherence=contrast
        )
        return frame.irradiance(factors)
