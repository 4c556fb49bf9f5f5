"""Inspection of pipes, welds, flanges, steps and gaps: features with uncertainty; measuring by picking points."""
