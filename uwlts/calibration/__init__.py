"""Calibration of the sensor: camera, laser sheet and window from captures."""
