"""Pages and nodes beside the sensor: the operator's desk, guided calibration, and ROS 2.

The stub beside this file lists the functions. Each is imported when it is first used.
"""

from uwlts.argument_types import attach_public

__getattr__, __dir__, __all__ = attach_public(__name__, __file__)
