"""Results of a campaign kept beside its recordings, so that nothing is evaluated twice."""

import json
from pathlib import Path
from typing import Any

from uwlts.errors import CaptureError
from uwlts.files import written_aside


def keep(path: Path, results: dict[str, Any], *, format: str, version: int) -> dict[str, Any]:
    """Write results into a file of a campaign's folder, whole or not at all; returns what the file holds."""
    content = {"format": format, "version": version} | results
    with written_aside(path, overwrite=True) as aside:
        aside.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
    return content


def up_to_date(path: Path) -> bool:
    """Whether there are results and no recording of the campaign is newer."""
    if not path.is_file():
        return False
    finished = path.stat().st_mtime_ns
    return all(recording.stat().st_mtime_ns <= finished for recording in path.parent.glob("*.h5"))


def kept(path: Path, *, format: str, version: int) -> dict[str, Any]:
    """Results as `keep` wrote them; CaptureError where the file is damaged or newer."""
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CaptureError(f"cannot read {path}: {error}; remove it to evaluate the campaign again") from error
    if not isinstance(results, dict) or (results.get("format"), results.get("version")) != (format, version):
        raise CaptureError(f"{path} holds no results that this program reads; remove it to evaluate again")
    return results
