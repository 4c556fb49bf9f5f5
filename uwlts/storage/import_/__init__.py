"""Import of images of any camera and program as a capture."""

from uwlts.storage.import_.camera_files import KnownCamera, read_intrinsics, set_intrinsics
from uwlts.storage.import_.folder import Imported, import_images
from uwlts.storage.import_.folder_description import NAME as DESCRIPTION_NAME
from uwlts.storage.import_.grey_values import Channel, check_channel, extract_channel
from uwlts.storage.import_.matching import image_files

__all__ = [
    "DESCRIPTION_NAME",
    "Channel",
    "Imported",
    "KnownCamera",
    "check_channel",
    "extract_channel",
    "image_files",
    "import_images",
    "read_intrinsics",
    "set_intrinsics",
]
