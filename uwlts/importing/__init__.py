"""Images of any camera and program turned into a capture that every other command takes.

`description` reads what is told about the images, `matching` and `positions` say which image is what and where it was
taken, `images` reads them by `decoding`, `content` refuses those that show nothing, and `folder` writes the capture.
`intrinsics` reads cameras that other programs calibrated.
"""

from uwlts.importing.folder import Imported, import_folder
from uwlts.importing.intrinsics import KnownCamera, read_intrinsics, with_intrinsics

__all__ = ["Imported", "KnownCamera", "import_folder", "read_intrinsics", "with_intrinsics"]
