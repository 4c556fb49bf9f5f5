"""Shapes that are measured: one class each, to find and fit the shape and to propagate errors."""
