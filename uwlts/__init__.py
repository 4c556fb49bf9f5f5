"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate, inspect.

The stub beside this file lists the public interface. Every name is imported when it is first used.
"""

from uwlts._version import __version__ as __version__
from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
