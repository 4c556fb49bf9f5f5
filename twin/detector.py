"""From light to grey values, after EMVA 1288: photons, electrons, noise, full well, gain, quantisation."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from uwlts.sensor import Camera, Detector

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0
"""h c in J m (SI, exact)."""


_BANDS = 8


def electrons_per_ms(irradiance: np.ndarray, camera: Camera, detector: Detector, *, wavelength_nm: float) -> np.ndarray:
    """Mean photo-electrons per ms and pixel for an irradiance in W/mm2 (EMVA 1288 release 4, Eq. 4)."""
    area_mm2 = (1e-3 * camera.pixel_size_um) ** 2
    photons_per_joule = 1e-9 * wavelength_nm / PLANCK_TIMES_LIGHT
    return irradiance * np.float32(1e-3 * area_mm2 * photons_per_joule * detector.quantum_efficiency)


def grey_values(
    electrons: np.ndarray, detector: Detector, *, exposure_ms: float, rng: np.random.Generator | None
) -> np.ndarray:
    """Image (H, W), uint8 or uint16, of mean photo-electrons (H, W); ``rng`` None leaves out all noise.

    Shot noise of signal and dark current is Poisson's; the full well clips before read noise and gain. Bands of rows
    have random numbers of their own, so that the image does not depend on how many of them are made at a time.
    """
    mean = electrons + np.float32(1e-3 * detector.dark_current_e_per_s * exposure_ms)
    if rng is None:
        return _digitised(mean, detector, None)
    bands = np.array_split(mean, _BANDS)
    with ThreadPoolExecutor() as pool:
        return np.concatenate(list(pool.map(_digitised, bands, [detector] * _BANDS, rng.spawn(_BANDS))))


def _digitised(mean: np.ndarray, detector: Detector, rng: np.random.Generator | None) -> np.ndarray:
    """Grey values of mean electrons of signal and dark current."""
    if rng is not None:
        mean = rng.poisson(mean).astype(np.float32)
    signal = np.minimum(mean, np.float32(detector.full_well_e))
    if rng is not None:
        signal += np.float32(detector.read_noise_e) * rng.standard_normal(signal.shape, dtype=np.float32)
    grey = np.rint(signal * np.float32(detector.gain_dn_per_e()) + np.float32(detector.black_level_dn))
    return np.clip(grey, 0, detector.full_scale_dn()).astype(np.uint8 if detector.bits == 8 else np.uint16)
