"""Windows of any tilt and thickness for property tests, also as faces for the oracle of least time."""

import math

import numpy as np
from hypothesis import strategies as st

from tests.oracles import fermat
from uwlts.model.calibration import WindowModel

indices = st.floats(1.0, 1.8)
tilts = st.floats(-20.0, 20.0)
seeds = st.integers(0, 2**32 - 1)


def tilted(x_deg: float, y_deg: float) -> np.ndarray:
    """Return the axis (0, 0, 1) rotated about x, then about y."""
    x, y = math.radians(x_deg), math.radians(y_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    return about_y @ about_x @ np.array([0.0, 0.0, 1.0])


windows = st.builds(
    lambda x, y, distance, thickness, glass, refractions: WindowModel(
        refractions=refractions,
        distance_mm=distance,
        normal=tuple(tilted(x, y)),
        thickness_mm=thickness,
        glass_index=glass,
    ),
    tilts,
    tilts,
    st.floats(5.0, 200.0),
    st.floats(1.0, 20.0),
    indices,
    st.sampled_from([1, 2]),
)


def faces_and_indices(window: WindowModel, medium_index: float) -> tuple[list[fermat.Face], list[float]]:
    """Return the window's faces and refractive indices for the oracle."""
    both = fermat.plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=np.array(window.normal))
    if window.refractions == 1:
        return both[:1], [1.0, medium_index]
    return both, [1.0, window.glass_index, medium_index]
