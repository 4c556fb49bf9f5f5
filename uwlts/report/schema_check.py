"""Digital calibration certificates (XML): description, and validation against a schema that the user has."""

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

from uwlts.errors import CaptureError
from uwlts.files.reading import read_text
from uwlts.report.digital_certificate import DCC
from uwlts.runtime.optional_library import optional_library

_MOST_BYTES = 64 * 2**20
"""Largest certificate; one with pictures of all its data has some megabytes."""
_SHOWN = 5
"""Number of places listed that a schema does not allow."""


def digital_certificate_lines(path: str | Path, schema: str | Path | None) -> list[str]:
    """Describe a digital calibration certificate; validate it against the schema file if one is given.

    Raises CaptureError if a file is missing or no XML of its kind, or the certificate is not valid, and SetupError
    without the library for schemas.
    """
    text = read_text(path, most_bytes=_MOST_BYTES, called="certificate", foreign="is not XML")
    if "<!DOCTYPE" in text:
        raise CaptureError(f"{path} has a document type; a digital calibration certificate has none")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise CaptureError(f"{path} is not valid XML: {error}") from error
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise CaptureError(f"{path} is XML, but no digital calibration certificate: its root is {root.tag!r}")

    def found(*names: str) -> str:
        return root.findtext("/".join((".", *(f"{{{DCC}}}{name}" for name in names)))) or "not stated"

    core = ("administrativeData", "coreData")
    quantities = sum(1 for _ in root.iter(f"{{{DCC}}}quantity"))
    lines = [
        f"digital calibration certificate {found(*core, 'uniqueIdentifier')}, schema {root.get('schemaVersion')}",
        f"calibrated {found(*core, 'beginPerformanceDate')} to {found(*core, 'endPerformanceDate')}; "
        f"{quantities} quantities",
    ]
    if schema is None:
        return [*lines, "not validated: name the published schema (dcc.xsd) by `schema`"]
    problems = _find_problems(Path(path), Path(schema))
    if problems:
        more = f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        raise CaptureError(f"{path} is not valid by {schema}: {'; '.join(problems[:_SHOWN])}{more}")
    return [*lines, f"valid by {schema}"]


def _find_problems(path: Path, schema: Path) -> list[str]:
    """Return the places that the schema does not allow. Schemas that it imports are read from its folder only."""
    if not schema.is_file():
        raise CaptureError(f"the schema {schema} does not exist; download dcc.xsd and the schemas that it imports")
    library = optional_library("xmlschema", needed_by="validation by an XML schema", extra="schema")
    others = {each for each in schema.absolute().parent.glob("*.xsd") if each.name != schema.name}
    try:
        locations = {ET.parse(each).getroot().get("targetNamespace", ""): str(each) for each in others}
        with warnings.catch_warnings():
            # Schemas that are missing are an error below, as soon as the schema uses them.
            warnings.simplefilter("ignore")
            checker = library.XMLSchema(str(schema.absolute()), locations=locations, allow="local")
        errors = list(checker.iter_errors(str(path.absolute())))
    except (ET.ParseError, library.XMLSchemaException, OSError) as error:
        raise CaptureError(
            f"the schema {schema} cannot be read: {error}. Put the schemas that it imports into its folder"
        ) from error
    return [f"{each.path}: {each.reason}" for each in errors]
