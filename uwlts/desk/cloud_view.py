"""View of the cloud in the page, a NiceGUI element drawn by three.js."""

from collections.abc import Callable, Sequence

import numpy as np
from nicegui.element import Element

from uwlts.pages.cloud_figure import THREE, VIEW


class CloudView(Element, component=VIEW, esm={"nicegui-scene": str(THREE.parent)}, default_classes="w-full"):
    """View of the board's cloud; ``picked`` is called with the position (3,) in mm of a clicked point."""

    def __init__(self, picked: Callable[[np.ndarray], None] | None = None):
        super().__init__()
        self._props |= {"field": "depth", "version": -1, "marks": [], "fit": 0, "closer": False}
        if picked is not None:
            self.on("pick", lambda event: picked(np.array(event.args["at"], float)))

    def show_version(self, version: int) -> None:
        """Make the browser fetch the cloud if its version differs."""
        self._set_parameter("version", version)

    def allow_detail(self, allowed: bool) -> None:
        """Set whether more points can be fetched for a closer view."""
        self._set_parameter("closer", allowed)

    def colour_by(self, field: str) -> None:
        """Colour the points by depth or a field."""
        self._set_parameter("field", field)

    def mark_places(self, places_mm: Sequence[np.ndarray]) -> None:
        """Mark positions (3,) in mm."""
        self._set_parameter("marks", [place.tolist() for place in places_mm])

    def fit(self) -> None:
        """Fit the whole cloud into the view."""
        self._set_parameter("fit", self._props["fit"] + 1)

    def _set_parameter(self, name: str, value: object) -> None:
        if self._props[name] != value:
            self._props[name] = value
            self.update()
