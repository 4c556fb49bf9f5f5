"""Plots, tables and pages: reports of campaigns, certificates and model comparisons.

The stub beside this file lists the pages that can be written. Each is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
