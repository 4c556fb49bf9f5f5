"""Shapes that are measured: each is one class that finds, fits and differentiates itself."""
