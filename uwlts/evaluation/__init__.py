"""Artefacts in point clouds: figures with uncertainty, and comparison with ground truth."""
