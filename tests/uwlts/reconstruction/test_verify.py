"""Warnings and limits that a verification reports beside its verdicts."""

import numpy as np

from uwlts.reconstruction.verify import find_undetectable_errors


def test_a_reversed_stage_that_sizes_cannot_show_is_named():
    """A reversed stage that moves square to the sheet mirrors the cloud, which does not change lengths.

    At 30 deg from this direction, it shears the cloud by 2 tan 30 deg.
    """
    positions = np.arange(5.0)
    for direction in ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)):
        (said,) = find_undetectable_errors("spheres", positions, direction)
        assert "spheres" in said and "mirror image" in said
    assert find_undetectable_errors("spheres", positions, (0.866, 0.0, 0.5)) == ()
    assert find_undetectable_errors("step", np.zeros(3), (1.0, 0.0, 0.0)) == (), "nothing moved"
