"""Correction of a platform's trajectory by surfaces that it shows more than once."""
