"""Inspection of pipes and welds: features with uncertainty; measuring by picking points.

Numbers are chosen by hand with the reasons beside them, and results with them checked by docs/studies/inspection.py.
"""
