"""Descriptions of a coarse sensor and a rotated board, which the twin serves in tests of scans."""

from collections.abc import Sequence


def small_sensor(*stage: str) -> str:
    """The thesis's sensor with 96 x 512 pixels; ``stage`` are lines of its table of the stage."""
    table = "\n".join(("[stage]", *stage)) if stage else ""
    return f"""
base = "thesis"
name = "small"
[camera]
width_px = 96
height_px = 512
pixel_size_um = 10.6
{table}
[lamp]
ambient_w_per_m2 = 0.05
"""


def turned_board(*motion: str, width_mm: float = 200.0, more: Sequence[str] = ()) -> str:
    """A board turned by 30 deg about Y, in air; ``motion`` are lines of its table, ``more`` those of other tables."""
    lines = "\n".join((*motion, *more))
    return f"""
title = "Board"
medium = "air"
[motion]
{lines}
[[objects]]
kind = "plate"
width_mm = {width_mm}
height_mm = 160.0
rotation_deg = [0.0, 30.0, 0.0]
"""
