"""Experiments: rendered campaigns are calibrated, measured and compared with the truth."""
