"""Cameras, stages and lasers: drivers and scans."""
