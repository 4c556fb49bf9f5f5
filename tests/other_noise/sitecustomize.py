"""Other random numbers in a process of the test suite, chosen by the environment variable `TEST_NOISE`.

Every seed that is given to NumPy or to Mitsuba is combined with the chosen number: all rendered, detected and synthetic
noise differs, while equal seeds still give equal numbers. This folder stands in PYTHONPATH (`tests/conftest.py`), so
that Python imports this module at the start of each process that a test starts.
"""

import os

import numpy as np

_NOISE = int(os.environ["TEST_NOISE"])
_Sequence, _default_rng = np.random.SeedSequence, np.random.default_rng


def _mixed(seed: object) -> object:
    """The seed, one integer or several, together with the chosen number."""
    return seed if seed is None else [_NOISE, *np.atleast_1d(np.asarray(seed)).tolist()]


class _MixedSequence(_Sequence):
    """A sequence of seeds; those that it spawns inherit the mixed entropy."""

    def __init__(self, entropy: object = None, **options: object) -> None:
        super().__init__(_mixed(entropy), **options)


def _mixed_rng(seed: object = None) -> np.random.Generator:
    made = isinstance(seed, np.random.Generator | np.random.BitGenerator | _Sequence)
    return _default_rng(seed if made else _mixed(seed))


np.random.SeedSequence, np.random.default_rng = _MixedSequence, _mixed_rng


def change_mitsuba() -> None:
    """Combine the chosen number with the seeds of Mitsuba's renderings, random walks and places of samples."""
    import mitsuba as mi

    render, sample, sample_float = mi.render, mi.sample_tea_32, mi.sample_tea_float32
    key = 0x9E3779B9 * _NOISE % 2**32  # spreads small numbers over all 32 bits

    mi.render = lambda *arguments, seed=0, **options: render(*arguments, seed=seed + 7919 * _NOISE, **options)
    mi.sample_tea_32 = lambda seed, number, *more: sample(seed ^ key, number, *more)
    mi.sample_tea_float32 = lambda number, seed, *more: sample_float(number, seed ^ key, *more)
