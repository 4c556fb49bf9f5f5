"""Settings of the alignment of a trajectory."""

from dataclasses import dataclass

from scipy.stats import chi2


@dataclass(frozen=True)
class AlignmentOptions:
    """Settings of `align_trajectory`.

    Values without a data set follow from the method.
    """

    search_sigmas: float = 3.0  # search range in standard deviations of the drift: 99.7 % of normal errors
    pixel: float = 0.5  # pixel of height maps (unit: patch radius): patches resolve no finer structures
    least_spread: float = 1e-3
    """Least product of both variances in an overlap, relative to the median; with less, the maps show no structure."""
    # Sizes of compared structures in height maps (unit: pixel). Coarser slopes are those of a tilted path. Chosen on a
    # simulated loop of 4 m.
    finest_px: float = 1.0
    coarsest_px: float = 12.0
    least_correlation: float = 0.35
    """Least correlation of two height maps of one surface; noise, tilts and gaps reduce it. Chosen on the same loop."""
    proposals: int = 4
    """Number of positions tried for each pair of pieces: the true one and its most similar alternatives."""
    least_lying: float = 0.6
    """Least fraction of coinciding patches after a rigid fit of two pieces, which the drift still deforms. Chosen on
    the same loop."""
    decided_after: int = 4
    """Number of pieces after which a hypothesis is decided: a crossing and its alternatives appear within this number
    of swath widths."""
    rival_share: float = 0.5
    """Least number of patches of a consistent rival position, relative to the best one, that makes a crossing
    ambiguous."""
    least_gain: float = 2.0
    """Least ratio of the navigation's position uncertainty at a crossing to that after the alignment; with less, the
    trajectory is not corrected."""
    fewest_patches: int = 30  # least number of patches of a crossing: five for each parameter of a rigid motion
    # Least fraction of all patches of a crossing, and of its held-out patches, that agree within ``agreeing_sigmas``.
    # Wrong positions reach 0.8 of all patches, since the path adapts, but few held-out ones. Chosen on rendered passes.
    least_agreeing: float = 0.9
    least_held_out: float = 0.8
    fewest_held_out: int = 10  # least number of held-out patches for a test of their fraction
    agreeing_sigmas: float = 5.0
    """Largest distance of an agreeing patch in standard deviations of the noise of the points."""
    held_out_every: int = 5  # one cube in this number is held out of the estimate for validation
    held_out_cube: float = 4.0
    """Side of these cubes (unit: patch radius), large because neighbouring patches share points."""
    intervals: int = 100
    """Number of intervals between regular nodes of the path: within one, a random walk moves by a tenth of its
    total."""
    most_nodes: int = 400  # largest number of nodes in crossings: normal matrices of 3000 unknowns take 72 MB
    node_spacing: float = 0.5
    """Least spacing of nodes in crossings (unit: patch radius). It is doubled while the drift deviates from a straight
    line between nodes by less than the noise of patches. Chosen on simulated passes with a walk of 30 mm."""
    rounds: int = 15  # largest number of least-squares rounds
    still: float = 0.03
    """Root-mean-square step, in standard deviations, that ends the rounds; changes of correspondences cause smaller
    steps."""
    refits: int = 8
    """Largest number of times that patches are refitted along the corrected path, because drift tilts them."""
    settled: float = 0.1  # root-mean-square step, in standard deviations, that ends the refits

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance in six dimensions with the same probability as ``search_sigmas`` in one."""
        return float(chi2.ppf(chi2.cdf(self.search_sigmas**2, 1), 6))
