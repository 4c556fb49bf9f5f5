"""Figures of G. S. de Matos's thesis (UFSC 2017) that no other function gives: window study and budget.

`twin reproduce` compares them with its tables.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
