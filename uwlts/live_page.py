"""What the pages have in common that show a camera at work: the server, and images small enough to be sent often."""

import cv2
import numpy as np
import viser

_LONGEST_SIDE_PX = 900


class LivePage:
    """A page with a title. It can be seen from this machine only, unless another ``host`` is given.

    Attributes
    ----------
    server : viser.ViserServer
    address : str
        Where a browser finds it; the next free port is taken where the wanted one is in use.
    """

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 8080):
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.gui.configure_theme(control_layout="fixed", control_width="large", show_logo=False)
        self.server.gui.add_markdown(f"# {title}")
        self.address = f"http://{host}:{self.server.get_port()}"

    def close(self) -> None:
        """End the page."""
        self.server.stop()


def small_picture(image: np.ndarray, *, full_dn: int) -> tuple[np.ndarray, float]:
    """The image (H, W) as a picture (h, w, 3) of uint8 with its dark parts raised, and its scale."""
    share = np.sqrt(image.astype(np.float32) / full_dn)
    grey = np.minimum(255 * share, 255).astype(np.uint8)
    scale = min(1.0, _LONGEST_SIDE_PX / max(grey.shape))
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2RGB), scale
