"""Where in a pixel, on the pupil and during the exposure the samples of a pixel are taken: one lattice for all pixels.

A rank-1 lattice is evenly spaced along every axis, so that a smooth stripe is integrated as by the midpoint rule,
without the noise of random samples.
"""

import math
from functools import cache

import numpy as np

_CANDIDATES = 64
"""How many generators are tried for every further axis; more improve the lattice by a few percent."""


def golden_step(count: int) -> int:
    """Second generator of a lattice of ``count`` points: the coprime number nearest to its golden section."""
    golden = count * 0.5 * (math.sqrt(5.0) - 1.0)
    return min((k for k in range(1, count + 1) if math.gcd(k, count) == 1), key=lambda k: abs(k - golden))


@cache
def lattice(count: int, axes: int) -> np.ndarray:
    """Points (axes, count) in the unit cube, in the middle of their strips along every axis.

    The first two generators are 1 and the golden step; each further one is the candidate with the least worst-case
    error of periodic functions with mixed second derivatives together with those before it: component by component,
    the mean of prod (1 + 2 pi^2 B2(x)) with B2(x) = x^2 - x + 1/6 (Sloan and Joe 1994, Eq. 4.8; Nuyens and Cools 2006).
    """
    index = np.arange(count, dtype=np.int64)
    steps = [1, golden_step(count)][:axes]
    # A step and its negative place the same points in mirrored order.
    coprime = [k for k in range(1, count // 2 + 1) if math.gcd(k, count) == 1] or [1]
    spread = np.linspace(0, len(coprime) - 1, min(_CANDIDATES, len(coprime))).astype(int)
    merit = np.prod([_kernel(index * step % count / count) for step in steps], axis=0)
    while len(steps) < axes:
        taken = {min(step, count - step) for step in steps}
        free = [coprime[k] for k in spread if coprime[k] not in taken] or coprime
        steps.append(min(free, key=lambda k: merit @ _kernel(index * k % count / count)))
        merit = merit * _kernel(index * steps[-1] % count / count)
    return np.stack([(index * step % count + 0.5) / count for step in steps])


def _kernel(x: np.ndarray) -> np.ndarray:
    return 1 + 2 * math.pi**2 * (x * x - x + 1 / 6)
