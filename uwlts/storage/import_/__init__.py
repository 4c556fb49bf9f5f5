"""Images of any camera and program turned into a capture."""

from uwlts.storage.import_.folder import Imported, import_images
from uwlts.storage.import_.intrinsics import KnownCamera, read_intrinsics, with_intrinsics

__all__ = ["Imported", "KnownCamera", "import_images", "read_intrinsics", "with_intrinsics"]
