"""Settings of a comparison of surfaces."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ComparisonOptions:
    """Settings that decide what a comparison reports.

    ``quiet_share`` was chosen on simulated pairs of clouds without a change. The history of the other values names no
    data; the reasons beside them follow from the method.

    Attributes
    ----------
    most_places : int
        Largest number of compared places. More take longer without a finer result.
    depth_per_disc : float
        Default search depth along the normal, in disc diameters.
    fewest_points : int
        Least number of points in a disc: with fewer, the roughness is unknown.
    quiet_share : float
        Fraction of the places, those of the lowest scatter, used to estimate the noise correlation within an image. The
        others may contain edges.
    area_neighbours : int
        Number of neighbours used to estimate the area of a place.
    fewest_of_region : int
        Least number of places of a reported region. Discs of neighbours overlap, so chance also produces pairs.
    other_unit_ratio : float
        Ratio of two sizes that indicates different units: between 1 and the 1000 of mm and m.
    """

    most_places: int = 20_000
    depth_per_disc: float = 3.0
    fewest_points: int = 5
    quiet_share: float = 0.8
    area_neighbours: int = 12
    fewest_of_region: int = 4
    other_unit_ratio: float = 50.0


OPTIONS = ComparisonOptions()
