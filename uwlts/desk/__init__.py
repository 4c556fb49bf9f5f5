"""Operator's page: scan, calibrate, view and measure in a browser."""
