"""Calibration of the camera: lens, image quality, and poses of a flat target."""
