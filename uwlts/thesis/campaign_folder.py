"""Folder of a campaign: its recordings by name.

Scans are named OBJECT-PLACEMENT-MEDIUM.h5, such as spheres-near-2-water.h5. The calibration has target-air.h5 (through
the camera's window), target-bare.h5 (without it), target-water.h5, and step-PLACEMENT-water.h5; line-width.h5 and
line-height.h5 show the stripe on the pipe for either orientation of the camera.
"""

from dataclasses import dataclass
from pathlib import Path

from uwlts.errors import CaptureError

MEDIA = ("air", "water")
OBJECTS = ("spheres", "plane", "pipe", "head", "weld")
STEP_PLACES = ("near", "standoff", "far")


@dataclass(frozen=True)
class ScanFile:
    """Recording of one object at a placement in a medium."""

    path: Path
    thing: str
    placement: str
    medium: str


@dataclass(frozen=True)
class CampaignFolder:
    """Recordings of one campaign."""

    path: Path

    def target(self, kind: str) -> Path:
        """Return the recording of the target "air", "bare" or "water"; CaptureError if it is missing."""
        return self._require_file(f"target-{kind}.h5")

    def steps(self) -> list[Path]:
        """Return the recordings of the step standard, nearest first."""
        return [self._require_file(f"step-{place}-water.h5") for place in STEP_PLACES]

    def line(self, side: str) -> Path | None:
        """Return the recording of the stripe on the pipe along an image side, or None."""
        path = self.path / f"line-{side}.h5"
        return path if path.is_file() else None

    def scans(self) -> list[ScanFile]:
        """Return all scans of objects, sorted by name."""
        found = []
        for path in sorted(self.path.glob("*.h5")):
            thing, *placement, medium = path.stem.split("-")
            if thing in OBJECTS and placement and medium in MEDIA:
                found.append(ScanFile(path, thing, "-".join(placement), medium))
        return found

    def _require_file(self, name: str) -> Path:
        path = self.path / name
        if not path.is_file():
            raise CaptureError(f"{self.path} has no {name}: record the campaign's calibration first")
        return path


def campaign_folders(folder: Path) -> list[CampaignFolder]:
    """Return the folders campaign-0, campaign-1, ... of a reproduction; CaptureError without any."""
    found = [path for path in folder.glob("campaign-*") if path.is_dir()]
    if not found:
        raise CaptureError(f"{folder} contains no campaign; expected folders campaign-0, campaign-1, ...")
    return [CampaignFolder(path) for path in sorted(found, key=lambda path: (len(path.name), path.name))]


def up_to_date(path: Path) -> bool:
    """Return whether there are results and no recording of the campaign is newer."""
    recordings = path.parent.glob("*.h5")
    return path.is_file() and all(each.stat().st_mtime_ns <= path.stat().st_mtime_ns for each in recordings)
