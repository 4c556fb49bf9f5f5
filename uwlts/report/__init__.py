"""Plots, tables and pages: reports of campaigns, certificates and model comparisons."""
