"""Digital twin of an underwater laser triangulation sensor: renders captures with Mitsuba 3.

`render` renders a scene into arrays, `simulate` into capture and truth files, `serve` plays it as camera and stage,
`record` renders a campaign of many captures, `dataset` a data set with labels, which `load_dataset` reads, `sweep`
searches the design of a sensor, `demo` runs the whole chain of commands, and `reproduce` the evaluation of the thesis.
The stub beside this file lists them. Each is imported when it is first used, as Mitsuba must not be imported before its
libLLVM is chosen.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
