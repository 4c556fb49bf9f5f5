"""Evaluation of recorded campaigns as in G. S. de Matos's thesis (UFSC 2017), compared with its tables.

`twin reproduce` records the campaigns and runs it.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
