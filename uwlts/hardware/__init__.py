"""Cameras, stages and lasers: drivers, scans, and guided calibration."""
