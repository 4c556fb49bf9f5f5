"""Plots, tables and pages: certificates, findings, changes.

The stub beside this file lists its functions. Each is imported when it is first used.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
