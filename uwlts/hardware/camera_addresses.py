"""Opening of a camera by its address; separate from the interface because it imports all drivers."""

from uwlts.errors import HardwareError
from uwlts.hardware.aravis import AravisCamera
from uwlts.hardware.camera_interface import CameraDevice
from uwlts.hardware.replay import ReplayCamera

ADDRESSES = """\
  gige:NAME or aravis:NAME  GigE Vision or USB3 Vision by Aravis: identifier, serial number or IP address;
                            without NAME the only camera there is
  replay:PATH               a folder of images, or a capture"""


def open_camera(address: str) -> CameraDevice:
    """Open the camera at an address such as "gige:127.0.0.1", see `ADDRESSES`.

    The camera is open but not configured. Use it as a context manager, which closes it.

    Raises HardwareError if the address has an unknown form, or no camera answers to it; the message lists the cameras
    found; SetupError if a library is missing; the message says how to install it.
    """
    kind, colon, rest = address.partition(":")
    camera: CameraDevice
    if kind in ("gige", "aravis") and colon:
        camera = AravisCamera(rest, address=address)
    elif kind == "replay" and rest:
        camera = ReplayCamera(rest, address=address)
    else:
        raise HardwareError(f"'{address}' is not a camera address; expected one of\n{ADDRESSES}")
    camera.open()
    return camera
