"""The operator's page: scan, calibrate, look and measure in a browser."""
