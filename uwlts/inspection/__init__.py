"""Inspection of pipes, welds, flanges, steps and gaps: features with uncertainty; measuring by picking points.

Numbers are chosen by hand with the reasons beside them, and results with them checked by docs/studies/inspection.py.
"""
