"""Libraries that only some features need; the message for a missing one states the extra that installs it."""

from importlib import import_module
from types import ModuleType

from uwlts.errors import SetupError


def optional_library(module: str, *, needed_by: str, extra: str, instead: str = "") -> ModuleType:
    """Import a library, or a module of it; raises SetupError, ending with ``instead``, if it is not installed."""
    library = module.partition(".")[0]
    try:
        import_module(library)
        return import_module(module)
    except ImportError as error:
        raise SetupError(
            f"{needed_by} needs the library {library}, which is not installed: pip install 'uwlts[{extra}]'{instead}"
        ) from error
