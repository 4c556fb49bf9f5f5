"""Guidance during a calibration: quality of images, what is still missing and what to do next; without hardware."""
