"""Uncertainty along a corrected path against its covariances, point by point and between points."""

import numpy as np

from uwlts.reconstruction.path_uncertainty import correct_path_uncertainty
from uwlts.storage.cloud import PointUncertainty


def test_points_have_the_covariance_of_the_path_and_of_their_sensor():
    """Single points are exact (float32); covariances between images omit the 1 % assigned to single images."""
    rng = np.random.default_rng(2)
    images, coefficients, count = 60, 8, 1200
    at = np.linspace(0, 1, images)[:, None]
    basis = np.exp(-(((at - np.linspace(0, 1, coefficients)) / 0.2) ** 2))
    # As smooth as a drift: 1 % is left after less than twelve shapes.
    apart = np.subtract.outer(np.linspace(0, 1, coefficients), np.linspace(0, 1, coefficients))
    covariance = np.kron(np.exp(-((apart / 1.5) ** 2)), np.diag(np.square([5.0] * 3 + [0.01] * 3)))
    image, levers = rng.integers(images, size=count), rng.uniform(-300, 300, (count, 3))
    # Two parts of a sensor and the navigation's, mixed as patterns are.
    sensor, navigation = rng.standard_normal((2, count, 3)), 40 * rng.standard_normal((1, count, 3))
    mixed = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    patterns = np.tensordot(mixed, np.concatenate([sensor, navigation]), axes=1)
    noise = rng.standard_normal((count, 3, 3))
    own = noise @ noise.transpose(0, 2, 1)
    pairs = np.stack([own[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=1)
    known = PointUncertainty(pairs, np.zeros((count, 3)), patterns, shared={"sensor": mixed[:, :2]})
    blocks = covariance.reshape(coefficients, 6, coefficients, 6)
    poses = np.einsum("fc,cidj,fd->fij", basis, blocks, basis)
    found = correct_path_uncertainty(known, np.zeros((count, 3)), levers, image, basis, covariance, poses)
    cross = np.zeros((count, 3, 6))
    cross[:, :, :3] = np.eye(3)
    for axis, unit in enumerate(np.eye(3)):
        cross[:, :, 3 + axis] = np.cross(unit, levers)
    by = np.einsum("nij,nc->nicj", cross, basis[image]).reshape(count, 3, -1)
    path = by @ covariance @ by.transpose(0, 2, 1)
    expected = path + own + np.einsum("kni,knj->nij", sensor, sensor)
    size = np.sqrt(np.einsum("nii->ni", expected))
    np.testing.assert_allclose(
        found.covariance_mm2() / (size[:, :, None] * size[:, None]),
        expected / (size[:, :, None] * size[:, None]),
        atol=1e-4,
    )
    between = np.einsum("nia,ab,mjb->nimj", by[:40], covariance, by[40:80]) + np.einsum(
        "kni,kmj->nimj", sensor[:, :40], sensor[:, 40:80]
    )
    stated = np.einsum(
        "kni,kmj->nimj", found.patterns_mm[:, :40].astype(float), found.patterns_mm[:, 40:80].astype(float)
    )
    scale = size[:40, :, None, None] * size[None, None, 40:80]
    assert np.sqrt(np.mean(((stated - between) / scale) ** 2)) < 0.03
    # The contribution of the sensor remains separate from all others.
    again = np.tensordot(found.shared["sensor"].T, found.patterns_mm, axes=1)
    np.testing.assert_allclose(again, sensor, atol=1e-4)
