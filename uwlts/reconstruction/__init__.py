"""Stripes to points: reconstruction of captures, moving platforms, and the uncertainty of every point."""
