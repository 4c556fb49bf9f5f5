"""Polynomial reference method of the thesis."""
