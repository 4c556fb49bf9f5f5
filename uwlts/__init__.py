"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate, inspect.

The stub beside this file lists the public interface. Every name is imported when it is first used.
"""

import lazy_loader

from uwlts._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
