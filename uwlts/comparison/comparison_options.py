"""Settings of a comparison of surfaces."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ComparisonOptions:
    """Settings that decide what a comparison reports.

    ``quiet_share`` was chosen on simulated pairs of clouds without a change. The history of the other values names no
    data; the reasons beside them follow from the method.
    """

    most_places: int = 20_000
    """Largest number of compared places. More take longer without a finer result."""
    depth_per_disc: float = 3.0  # default search depth along the normal, in disc diameters
    fewest_points: int = 5  # least number of points in a disc: with fewer, the roughness is unknown
    quiet_share: float = 0.8
    """Fraction of the places, those of the lowest scatter, used to estimate the noise correlation within an image.
    The others may contain edges."""
    area_neighbours: int = 12  # number of neighbours used to estimate the area of a place
    fewest_of_region: int = 4
    """Least number of places of a reported region. Discs of neighbours overlap, so chance also produces pairs."""
    other_unit_ratio: float = 50.0
    """Ratio of two sizes that indicates different units: between 1 and the 1000 of mm and m."""


OPTIONS = ComparisonOptions()
