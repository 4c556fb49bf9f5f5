"""Plots, tables and pages: reports of campaigns, certificates and model comparisons."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["plot"])
