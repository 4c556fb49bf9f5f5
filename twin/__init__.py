"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3.

`render` renders a scene to arrays, and `simulate` to capture and truth files. `serve` provides a scene as camera and
stage hardware. `record` renders a campaign of captures. `dataset` renders a data set with labels, and `load_dataset`
reads it. `sweep` searches the best design of a sensor, and `experiment` calibrates a sensor,
measures scenes and compares the results with the truth; `predict` does so for all figures of a campaign.
`demo` runs the whole chain of commands, and `reproduce` the
evaluation of the thesis. The stub file lists all names. Each name is imported at its first use, because libLLVM must be
selected before Mitsuba is imported.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
