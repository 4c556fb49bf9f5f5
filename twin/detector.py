"""From light to grey values, after EMVA 1288: photons, electrons, noise, full well, gain, quantisation."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from twin.blooming import spilled
from twin.fixed_pattern import FixedPattern
from twin.poisson import poisson_numbers
from uwlts.errors import ImageError
from uwlts.sensor import Camera, Detector

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0
"""h c in J m (SI, exact)."""

MOST_ELECTRONS = 1e15
"""No pixel comes near it; beyond, Poisson numbers no longer fit into 64 bits."""

_BANDS = 8


def electrons_per_ms(irradiance: np.ndarray, camera: Camera, detector: Detector, *, wavelength_nm: float) -> np.ndarray:
    """Mean photo-electrons per ms and pixel for an irradiance in W/mm2 (EMVA 1288 release 4, Eq. 4)."""
    area_mm2 = (1e-3 * camera.pixel_size_um) ** 2
    photons_per_joule = 1e-9 * wavelength_nm / PLANCK_TIMES_LIGHT
    return irradiance * np.float32(1e-3 * area_mm2 * photons_per_joule * detector.quantum_efficiency)


def grey_values(
    electrons: np.ndarray,
    detector: Detector,
    *,
    exposure_ms: float,
    rng: np.random.Generator | None,
    pattern: FixedPattern | None = None,
) -> np.ndarray:
    """Image (H, W), uint8 or uint16, of mean photo-electrons (H, W).

    ``rng`` None leaves out all noise that changes from image to image, ``pattern`` None what differs from pixel to
    pixel. Shot noise of signal and dark current is Poisson's; blooming and the full well act before the readout, which
    adds its offset pattern and noise. Rounding is the only quantisation. Bands of rows have random numbers of their
    own, so that the image does not depend on how many of them are made at a time.

    Raises
    ------
    ImageError
        ``electrons`` is not a two-dimensional image of finite numbers from 0 to 1e15, or ``pattern`` has another size.
    """
    electrons = _checked(electrons, pattern)
    count = min(_BANDS, len(electrons))
    detectors, exposures = [detector] * count, [exposure_ms] * count
    patterns = [None] * count if pattern is None else pattern.bands(count)
    rngs = [None] * count if rng is None else _fast_generators(rng, count)
    with ThreadPoolExecutor() as pool:
        charges = list(pool.map(_collected, np.array_split(electrons, count), detectors, exposures, patterns, rngs))
        if detector.blooming > 0:
            bloomed = spilled(np.concatenate(charges), full_well_e=detector.full_well_e, share=detector.blooming)
            charges = np.array_split(bloomed, count)
        return np.concatenate(list(pool.map(_digitised, charges, detectors, patterns, rngs)))


def _checked(electrons: np.ndarray, pattern: FixedPattern | None) -> np.ndarray:
    electrons = np.asarray(electrons, np.float32)
    if electrons.ndim != 2 or electrons.size == 0:
        raise ImageError(f"mean electrons have the shape {electrons.shape}; expected an image (H, W)")
    lowest, highest = electrons.min(), electrons.max()
    if not (lowest >= 0 and highest <= MOST_ELECTRONS):
        raise ImageError(
            f"mean electrons run from {lowest:g} to {highest:g}; expected finite numbers from 0 to {MOST_ELECTRONS:g}"
        )
    if pattern is not None and pattern.gain.shape != electrons.shape:
        raise ImageError(
            f"the fixed pattern is of {pattern.gain.shape} pixels, the image of {electrons.shape}: make the pattern "
            "with the image's height and width"
        )
    return electrons


def _fast_generators(rng: np.random.Generator, count: int) -> list[np.random.Generator]:
    """Independent generators that continue the given one's seed; SFC64 is NumPy's fastest."""
    return [np.random.Generator(np.random.SFC64(seed)) for seed in rng.bit_generator.seed_seq.spawn(count)]


def _collected(
    electrons: np.ndarray,
    detector: Detector,
    exposure_ms: float,
    pattern: FixedPattern | None,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """Electrons of light and dark current that an exposure collects, before any are lost."""
    dark = np.float32(1e-3 * exposure_ms * detector.dark_current_e_per_s * detector.dark_current_growth())
    if pattern is None:
        mean = electrons + dark
    else:
        mean = electrons * pattern.gain
        mean += pattern.hot_e_per_s * np.float32(1e-3 * exposure_ms)
        mean += dark
    return mean if rng is None else poisson_numbers(mean, rng)


def _digitised(
    charge: np.ndarray, detector: Detector, pattern: FixedPattern | None, rng: np.random.Generator | None
) -> np.ndarray:
    """Grey values of collected electrons."""
    signal = np.minimum(charge, np.float32(detector.full_well_e))
    if pattern is not None:
        signal += pattern.offset_e
    if rng is not None:
        noise = rng.standard_normal(signal.shape, dtype=np.float32)
        noise *= np.float32(detector.read_noise_e)
        signal += noise
    signal *= np.float32(detector.gain_dn_per_e())
    signal += np.float32(detector.black_level_dn)
    np.rint(signal, out=signal)
    np.clip(signal, 0, detector.full_scale_dn(), out=signal)
    return signal.astype(np.uint8 if detector.bits == 8 else np.uint16)
