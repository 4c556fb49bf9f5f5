"""Artefacts in point clouds: figures with uncertainty, comparison with ground truth, gauge studies."""
