"""Version of both packages."""

__version__ = "0.3.0"
