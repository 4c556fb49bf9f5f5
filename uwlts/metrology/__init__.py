"""Evaluation of point clouds: fitted shapes, artefacts with calibrated sizes, comparison with ground truth."""
