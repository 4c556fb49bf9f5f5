"""Objects with closed-form surfaces as fine triangle meshes; they face -z, towards the sensor.

A new form is a class with its description, formula and triangles, and an entry in `AnyForm`.
"""

from twin.scene.forms.head import Head
from twin.scene.forms.parts import PittedPipe, Weld
from twin.scene.forms.seabed import Seabed

AnyForm = Head | PittedPipe | Seabed | Weld

__all__ = ["AnyForm", "Head", "PittedPipe", "Seabed", "Weld"]
