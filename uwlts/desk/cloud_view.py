"""The cloud in the page, an element of NiceGUI drawn by three.js."""

from collections.abc import Callable, Sequence
from pathlib import Path

import nicegui
import numpy as np
from nicegui.element import Element
from nicegui.events import GenericEventArguments

_THREE = Path(nicegui.__file__).parent / "elements" / "scene" / "dist"
"""NiceGUI's own copy of three.js, so that the page works without internet."""


class CloudView(Element, component="cloud_view.js", esm={"nicegui-scene": str(_THREE)}, default_classes="w-full"):
    """Shows the board's cloud; ``picked`` is called with the place (3,) in mm of a point that was clicked."""

    def __init__(self, picked: Callable[[np.ndarray], None] | None = None):
        super().__init__()
        self._props |= {"field": "depth", "version": -1, "marks": [], "fit": 0, "closer": False}
        if picked is not None:
            self.on("pick", lambda event: picked(_place(event)))

    def show_version(self, version: int) -> None:
        """Have the browser fetch the cloud, if it has another one."""
        self._set("version", version)

    def allow_detail(self, allowed: bool) -> None:
        """Whether there are more points to fetch when someone looks closer."""
        self._set("closer", allowed)

    def colour_by(self, field: str) -> None:
        """Colour by depth or one of the fields of a cloud."""
        self._set("field", field)

    def mark_places(self, places_mm: Sequence[np.ndarray]) -> None:
        """Mark places (3,)."""
        self._set("marks", [place.tolist() for place in places_mm])

    def fit(self) -> None:
        """Fit the whole cloud into the view."""
        self._set("fit", self._props["fit"] + 1)

    def _set(self, name: str, value: object) -> None:
        if self._props[name] != value:
            self._props[name] = value
            self.update()


def _place(event: GenericEventArguments) -> np.ndarray:
    return np.array(event.args["at"], dtype=float)
