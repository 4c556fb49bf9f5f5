"""Reconstruction, uncertainty of points and figures, evaluation and verification."""
