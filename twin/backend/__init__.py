"""The compiler library that the renderer needs."""
