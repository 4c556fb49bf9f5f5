"""Images of any camera and program turned into a capture that every other command takes.

`description` reads the description of a folder, `matching` assigns images to lights and positions, `images` reads them,
and `folder` refuses those that show nothing and writes the capture.
`intrinsics` reads cameras that other programs calibrated.
"""

from uwlts.importing.folder import Imported, import_folder
from uwlts.importing.intrinsics import KnownCamera, read_intrinsics, with_intrinsics

__all__ = ["Imported", "KnownCamera", "import_folder", "read_intrinsics", "with_intrinsics"]
