"""Settings of the alignment of a trajectory."""

from dataclasses import dataclass

from scipy.stats import chi2


@dataclass(frozen=True)
class AlignmentOptions:
    """Settings of `align_trajectory`, which follow from the method, or were chosen on a simulated or rendered pass.

    Attributes
    ----------
    search_sigmas : float
        Search range in standard deviations of the drift: 99.7 % of normal errors.
    finest_px, coarsest_px : float
        Sizes of the structures that height maps are compared by, in pixels of half a patch radius. Coarser slopes are
        those of a tilted path. Chosen on a simulated loop of 4 m.
    least_correlation : float
        Correlation of two height maps that may show one surface: noise, tilts and gaps lower it. Chosen on that loop.
    proposals : int
        Places that are tried for each pair of pieces: the true one and its likeliest doubles.
    least_lying : float
        Share of the patches that coincide after a rigid fit of two pieces, which the drift still bends. Chosen on that
        loop.
    decided_after : int
        Pieces after which a hypothesis is decided: a crossing and its doubles are seen within as many swath widths.
    rival_share : float
        Patches of another place, relative to the best one, that make a crossing doubtful if it holds too.
    least_gain : float
        Standard deviation of a shift at some crossing by the navigation, relative to that after the alignment: with
        less the trajectory is used as it is.
    fewest_patches : int
        Patches of a crossing: five for each parameter of a rigid movement.
    least_agreeing, least_held_out : float
        Share of all patches of a crossing, and of its held-out patches, that agree within ``agreeing_sigmas``. Wrong
        places reach 0.8 of all, since the path bends, but few of the held-out ones. Chosen on rendered passes.
    fewest_held_out : int
        Held-out patches of a crossing whose share is judged: that of fewer says little.
    agreeing_sigmas : float
        Standard deviations of a distance, by the noise of the points alone, within which a patch agrees.
    held_out_every : int
        One of so many cubes is held out of the estimate and judges it.
    held_out_cube : float
        Side of these cubes in patch radii: neighbouring patches share points.
    intervals : int
        Intervals between even nodes of the path: a random walk moves by a tenth of its whole within one.
    most_nodes : int
        Nodes within crossings at most: normal matrices of 3000 unknowns take 72 MB.
    node_spacing : float
        Distance of nodes within crossings in patch radii: with half of one the walk between nodes stays below the
        scatter of patches. Chosen on simulated passes with a walk of 30 mm.
    rounds : int
        Rounds of least squares at most.
    still : float
        Root mean square step, in standard deviations, that ends the rounds: changing matches make smaller steps.
    refits : int
        Times at most that patches are fitted anew to the corrected path in the end: the drift within them tilts them.
    settled : float
        Root mean square step, in standard deviations, that ends these.
    """

    search_sigmas: float = 3.0
    finest_px: float = 1.0
    coarsest_px: float = 12.0
    least_correlation: float = 0.35
    proposals: int = 4
    least_lying: float = 0.6
    decided_after: int = 4
    rival_share: float = 0.5
    least_gain: float = 2.0
    fewest_patches: int = 30
    least_agreeing: float = 0.9
    least_held_out: float = 0.8
    fewest_held_out: int = 10
    agreeing_sigmas: float = 5.0
    held_out_every: int = 5
    held_out_cube: float = 4.0
    intervals: int = 100
    most_nodes: int = 400
    node_spacing: float = 0.5
    rounds: int = 15
    still: float = 0.03
    refits: int = 8
    settled: float = 0.1

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance of a shift and a turn that is as likely as ``search_sigmas`` of one number."""
        return float(chi2.ppf(chi2.cdf(self.search_sigmas**2, 1), 6))
