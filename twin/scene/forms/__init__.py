"""Objects with closed-form surfaces as fine triangle meshes; they face -z, towards the sensor.

A new form is a class with its description, formula and triangles, and an entry in `Part` or `AnyForm`.
"""

from twin.scene.forms.head import Head
from twin.scene.forms.parts import Flange, Part, PittedPipe, Weld
from twin.scene.forms.seabed import Seabed

AnyForm = Part | Head | Seabed

__all__ = ["AnyForm", "Flange", "Head", "PittedPipe", "Seabed", "Weld"]
