"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3.

The stub file lists all names. Each name is imported at its first use, because libLLVM must be selected before Mitsuba
is imported.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
