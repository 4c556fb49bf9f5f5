"""Reflection and transmission at an interface between two clear media, from the continuity of the fields.

No closed Fresnel formula is used: the amplitudes solve the linear equations that the tangential electric and magnetic
fields are equal on both sides, and the powers follow from Poynting's vector.
"""

import numpy as np


def fresnel_powers(cosine_in: np.ndarray, *, n1: float, n2: float) -> tuple[np.ndarray, np.ndarray]:
    """Return reflected and transmitted fractions of the power, both (..., 2), for s and p polarisation.

    ``cosine_in`` is the cosine of the angle in medium 1. Under total reflection the field behind the interface decays
    (an imaginary cosine) and carries no power away.
    """
    cosine_in = np.asarray(cosine_in, dtype=complex)
    cosine_out = np.sqrt(1 - (n1 / n2) ** 2 * (1 - cosine_in**2))
    one = np.ones_like(cosine_in)
    # s: E is across the plane of incidence. Continuity of E: 1 + r = t; of H: n1 c1 (1 - r) = n2 c2 t.
    # p: H is across it. In amplitudes of E: n1 (1 + r) = n2 t and c1 (1 - r) = c2 t.
    systems = {
        "s": ([[-one, one], [n1 * cosine_in, n2 * cosine_out]], [one, n1 * cosine_in]),
        "p": ([[-n1 * one, n2 * one], [cosine_in, cosine_out]], [n1 * one, cosine_in]),
    }
    reflected, transmitted = [], []
    for matrix, right in systems.values():
        matrix = np.moveaxis(np.array(matrix), (0, 1), (-2, -1))
        right = np.moveaxis(np.array(right), 0, -1)
        r, t = np.moveaxis(np.linalg.solve(matrix, right[..., None])[..., 0], -1, 0)
        reflected.append(np.abs(r) ** 2)
        transmitted.append(np.real(n2 * cosine_out) / np.real(n1 * cosine_in) * np.abs(t) ** 2)
    return np.stack(reflected, axis=-1), np.stack(transmitted, axis=-1)


def fresnel_transmittance(cosine_in: np.ndarray, *, n1: float, n2: float) -> np.ndarray:
    """Return the transmitted fraction of the power of unpolarised light from medium 1 into 2, like ``cosine_in``."""
    return fresnel_powers(cosine_in, n1=n1, n2=n2)[1].mean(axis=-1)
