"""Digital calibration certificate (DCC) of the PTB: a certificate as XML with values in the D-SI format.

The structure is that of the schemas dcc.xsd 3.2.0 and SI_Format.xsd 2.1.0 (https://www.ptb.de/dcc). They require
statements on laboratory, customer, item and responsible persons, which an `Administration` contains.
"""

import datetime
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from uwlts.errors import CaptureError, EvaluationError
from uwlts.files.reading import read_text
from uwlts.model.library import read_table, validate_description
from uwlts.model.sensor import Description
from uwlts.report.certificate import Certificate

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
SCHEMA_VERSION = "3.2.0"
_SCHEMA = f"https://ptb.de/dcc/v{SCHEMA_VERSION}/dcc.xsd"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_LANGUAGE = "en"
_COVERAGE = ("2", "0.95")
"""Coverage factor and coverage probability of expanded uncertainties (GUM, normal distribution, rounded)."""

UNITS = {
    "": r"\one",
    "px": r"\one",
    "mm": r"\milli\metre",
    "µm": r"\micro\metre",
    "µm/m": r"\micro\metre\metre\tothe{-1}",
    "°": r"\degree",
}
"""Units in the D-SI format; pixels are counted."""


def _check_text(text: str) -> str:
    """Check that a text is not empty, and has no spaces at its ends, as the schema demands."""
    if not text or text != text.strip():
        raise ValueError("expected a text without spaces at its ends")
    return text


Text = Annotated[str, AfterValidator(_check_text)]
Country = Annotated[str, Field(pattern="^[A-Z]{2}$")]


class Contact(Description):
    """Name and address of a laboratory, customer or manufacturer; ``country`` is the code of ISO 3166-1."""

    name: Text
    country: Country
    city: Text
    post_code: Text | None = None
    street: Text | None = None
    e_mail: Text | None = None


class ResponsiblePerson(Description):
    """Person who is responsible for the certificate; the main signer signs it."""

    name: Text
    role: Text | None = None
    main_signer: bool = False


class CalibratedItem(Description):
    """The calibrated sensor: its serial number, manufacturer and model."""

    serial_number: Text
    manufacturer: Text
    model: Text | None = None


EquipmentRole = Literal["target", "step standard", "thermometer", "other"]


class Equipment(Description):
    """Measuring equipment of the calibration, and the number of its certificate."""

    role: EquipmentRole
    name: Text
    serial_number: Text | None = None
    certificate: Text | None = None
    manufacturer: Text | None = None
    model: Text | None = None


class Administration(Description):
    """Administrative data of a digital calibration certificate, read from TOML.

    ``traceability`` says how the values of the ``equipment`` are traceable to the SI.
    """

    identifier: Text  # unique identifier of the certificate
    # First and last day of the calibration.
    begin: datetime.date
    end: datetime.date
    location: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "laboratory"
    """Place of the calibration: laboratory, customer, laboratoryBranch, customerBranch or other."""
    laboratory: Contact
    customer: Contact
    item: CalibratedItem
    persons: tuple[ResponsiblePerson, ...] = Field(min_length=1)
    traceability: Text | None = None
    equipment: tuple[Equipment, ...] = ()

    @model_validator(mode="after")
    def _check_times(self) -> "Administration":
        if self.end < self.begin:
            raise ValueError(f"the calibration ends on {self.end}, before it begins on {self.begin}")
        return self


def state_traceability(content: Certificate, administration: Administration | None) -> tuple[bool, str]:
    """Return whether the calibration is traceable by its stated equipment, and a sentence.

    Traceability needs a statement, and a certificate of each piece of equipment that the calibration used.
    """
    used = ["target"] if content.made_from.get("target") else []
    used += ["step standard"] if content.made_from.get("step_captures") else []
    # An index that follows from the temperature rests on a thermometer.
    used += ["thermometer"] if any(each.medium.kind in ("fresh", "sea") for each in content.validity) else []
    equipment = () if administration is None else administration.equipment
    certified = {each.role for each in equipment if each.certificate is not None}
    missing = [f"no certificate of the {role}" for role in used if role not in certified]
    if administration is None or administration.traceability is None:
        missing.insert(0, "no statement of traceability")
    if missing:
        return False, f"Traceability to the SI is not shown: {', '.join(missing)}."
    assert administration is not None and administration.traceability is not None
    return True, administration.traceability


def load_administration(path: str | Path) -> Administration:
    """Read administrative data; DescriptionError if the file is missing or not valid."""
    return validate_description(Administration, read_table(Path(path)), path)


def digital_certificate(content: Certificate, administration: Administration) -> str:
    """Return a certificate as the text of a digital calibration certificate (XML).

    EvaluationError if the certificate has a unit that D-SI does not have.
    """
    for prefix, uri in (("dcc", DCC), ("si", SI), ("xsi", _XSI)):
        ET.register_namespace(prefix, uri)
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", {"schemaVersion": SCHEMA_VERSION})
    root.set(f"{{{_XSI}}}schemaLocation", f"{DCC} {_SCHEMA}")
    _add_administration(_add_child(root, "administrativeData"), content, administration)
    _add_results(_add_child(_add_child(root, "measurementResults"), "measurementResult"), content, administration)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=False).join(
        ('<?xml version="1.0" encoding="UTF-8"?>\n', "\n")
    )


def _add_administration(parent: ET.Element, content: Certificate, stated: Administration) -> None:
    software = _add_child(_add_child(parent, "dccSoftware"), "software")
    program, _, release = content.software.partition(" ")
    _add_text(software, "name", program)
    _add_child(software, "release", release or "unknown")
    core = _add_child(parent, "coreData")
    _add_child(core, "countryCodeISO3166_1", stated.laboratory.country)
    _add_child(core, "usedLangCodeISO639_1", _LANGUAGE)
    _add_child(core, "mandatoryLangCodeISO639_1", _LANGUAGE)
    _add_child(core, "uniqueIdentifier", stated.identifier)
    _add_child(core, "beginPerformanceDate", stated.begin.isoformat())
    _add_child(core, "endPerformanceDate", stated.end.isoformat())
    _add_child(core, "performanceLocation", stated.location)
    _add_child(core, "issueDate", content.issued[:10])
    item = _add_child(_add_child(parent, "items"), "item")
    _add_text(item, "name", content.sensor)
    _add_text(_add_child(item, "manufacturer"), "name", stated.item.manufacturer)
    if stated.item.model is not None:
        _add_child(item, "model", stated.item.model)
    identifications = _add_child(item, "identifications")
    _identify(identifications, "manufacturer", stated.item.serial_number, "serial number", "basic_serialNumber")
    _identify(identifications, "other", content.calibration.sha256, "SHA-256 of the calibration file")
    _identify(identifications, "other", content.calibration.digest, "identifier of the calibration in clouds")
    if content.sha256:
        _identify(identifications, "other", content.sha256, "SHA-256 of the sealed certificate (JSON)")
    _add_contact(_add_child(_add_child(parent, "calibrationLaboratory"), "contact"), stated.laboratory)
    persons = _add_child(parent, "respPersons")
    for each in stated.persons:
        person = _add_child(persons, "respPerson")
        _add_text(_add_child(person, "person"), "name", each.name)
        if each.role is not None:
            _add_child(person, "role", each.role)
        _add_child(person, "mainSigner", str(each.main_signer).lower())
    _add_contact(_add_child(parent, "customer"), stated.customer)
    statements = _add_child(parent, "statements")
    traceable, sentence = state_traceability(content, stated)
    statement = _add_child(statements, "statement")
    _add_child(statement, "traceable", str(traceable).lower())
    _add_text(statement, "declaration", sentence)
    for text in _list_statements(content):
        _add_text(_add_child(statements, "statement"), "declaration", text)


def _list_statements(content: Certificate) -> Iterator[str]:
    yield (
        "Uncertainties are expanded uncertainties with the coverage factor k = 2, for a coverage probability of about "
        "95 % with a normal distribution (GUM, JCGM 100:2008)."
    )
    if content.remark is not None:
        yield content.remark
    yield "Lengths are valid in the volume that the evidence of the calibration covers, which is stated."
    yield from content.cannot_tell


def _add_results(parent: ET.Element, content: Certificate, stated: Administration) -> None:
    _add_text(parent, "name", f"Calibration of {content.sensor}")
    method = _add_child(_add_child(parent, "usedMethods"), "usedMethod")
    method.set("refType", "basic_methodMeasurementUncertainty")
    _add_text(method, "name", "joint calibration of camera, window and laser sheet")
    _add_child(method, "norm", "JCGM 100:2008")
    if stated.equipment:
        _add_equipment(_add_child(parent, "measuringEquipments"), stated)
    if content.validity:
        _add_medium(_add_child(parent, "influenceConditions"), content)
    results = _add_child(parent, "results")
    parameters = _add_result(results, "Parameters")
    for row in content.parameters:
        if row.unit not in UNITS:
            raise EvaluationError(f"the unit {row.unit!r} of {row.name} is none of {', '.join(map(repr, UNITS))}")
        text = f"{row.words} ({row.name}){' in pixels' if row.unit == 'px' else ''}"
        _quantity(parameters, text, row.value, UNITS[row.unit], None if row.std is None else 2 * row.std)
    if content.lengths:
        lengths = _add_result(results, "Lengths measured on surfaces of many points")
        points = _add_result(results, "Lengths between two single points")
        for each in content.lengths:
            text = f"length of {each.length_mm:g} mm along {each.axis}"
            for group, expanded in ((lengths, each.calibration_mm), (points, each.point_mm)):
                _quantity(group, text, each.length_mm, UNITS["mm"], expanded, "basic_nominalValue")
    if content.validity:
        volume = _add_result(results, "Volume")
        for region in content.validity:
            ends = {"distance from the pupil": region.camera_depth_mm, "Y": region.y_mm, "Z": region.z_mm}
            for text, pair in ends.items():
                for end, value in zip(("smallest", "largest"), pair, strict=True):
                    _quantity(volume, f"{end} {text} in {region.name}", value, UNITS["mm"], None)


def _add_equipment(parent: ET.Element, stated: Administration) -> None:
    for each in stated.equipment:
        equipment = _add_child(parent, "measuringEquipment")
        equipment.set("refType", "basic_measurementStandard")
        _add_text(equipment, "name", f"{each.role}: {each.name}")
        if each.manufacturer is not None:
            _add_text(_add_child(equipment, "manufacturer"), "name", each.manufacturer)
        if each.model is not None:
            _add_child(equipment, "model", each.model)
        numbers = [
            ("manufacturer", each.serial_number, "serial number", "basic_serialNumber"),
            ("calibrationLaboratory", each.certificate, "certificate", "basic_certificateIdentifier"),
        ]
        if any(value is not None for _, value, *_ in numbers):
            identifications = _add_child(equipment, "identifications")
            for issuer, value, text, kind in numbers:
                if value is not None:
                    _identify(identifications, issuer, value, text, kind)


def _add_medium(parent: ET.Element, content: Certificate) -> None:
    for region in content.validity:
        condition = _add_child(parent, "influenceCondition")
        _add_text(condition, "name", f"medium {region.name}: {region.medium.kind}")
        data = _add_child(condition, "data")
        expanded = None if region.index_std is None else 2 * region.index_std
        _quantity(data, "refractive index relative to air", region.index, UNITS[""], expanded)
        if region.medium.kind in ("fresh", "sea"):
            _quantity(data, "temperature", region.medium.temperature_c, r"\degreecelsius", None, "basic_temperature")


def _add_result(parent: ET.Element, text: str) -> ET.Element:
    result = _add_child(parent, "result")
    _add_text(result, "name", text)
    return _add_child(result, "data")


def _quantity(
    parent: ET.Element, text: str, value: float, unit: str, expanded: float | None, kind: str = "basic_measuredValue"
) -> None:
    """Add a real quantity of a ``kind`` (refType) with its expanded uncertainty, if known."""
    quantity = _add_child(parent, "quantity")
    quantity.set("refType", kind)
    _add_text(quantity, "name", text)
    real = ET.SubElement(quantity, f"{{{SI}}}real")
    known = expanded is not None and expanded > 0
    ET.SubElement(real, f"{{{SI}}}value").text = _format_decimal(value, expanded if known else None)
    ET.SubElement(real, f"{{{SI}}}unit").text = unit
    if expanded is not None:
        uncertainty = ET.SubElement(real, f"{{{SI}}}expandedUnc")
        factor, probability = _COVERAGE
        ET.SubElement(uncertainty, f"{{{SI}}}uncertainty").text = _format_decimal(expanded, expanded if known else None)
        ET.SubElement(uncertainty, f"{{{SI}}}coverageFactor").text = factor
        ET.SubElement(uncertainty, f"{{{SI}}}coverageProbability").text = probability
        ET.SubElement(uncertainty, f"{{{SI}}}distribution").text = "normal"


def _format_decimal(value: float, expanded: float | None) -> str:
    """Return a number in the form of D-SI, with the digits of two significant ones of its uncertainty (GUM 7.2.6).

    Without an uncertainty it has nine significant digits.
    """
    if expanded is None:
        return f"{value:.9g}"
    # Of the rounded uncertainty: 0.0996 is 0.10 and has two decimals.
    decimals = 1 - math.floor(math.log10(float(f"{expanded:.1e}")))
    return f"{round(value, decimals) or 0.0:.{max(0, decimals)}f}"


def _add_contact(parent: ET.Element, contact: Contact) -> None:
    _add_text(parent, "name", contact.name)
    if contact.e_mail is not None:
        _add_child(parent, "eMail", contact.e_mail)
    location = _add_child(parent, "location")
    given = {
        "city": contact.city,
        "countryCode": contact.country,
        "postCode": contact.post_code,
        "street": contact.street,
    }
    for name, text in given.items():
        if text is not None:
            _add_child(location, name, text)


def _identify(parent: ET.Element, issuer: str, value: str, text: str, kind: str | None = None) -> None:
    identification = _add_child(parent, "identification")
    if kind is not None:
        identification.set("refType", kind)
    _add_child(identification, "issuer", issuer)
    _add_child(identification, "value", value)
    _add_text(identification, "name", text)


def _add_child(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(parent, f"{{{DCC}}}{name}")
    if text is not None:
        # XML 1.0 cannot contain other characters.
        child.text = re.sub(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)
    return child


def _add_text(parent: ET.Element, name: str, text: str) -> None:
    """Add an element with a text in the language of the certificate."""
    content = _add_child(_add_child(parent, name), "content", text)
    content.set("lang", _LANGUAGE)


_MOST_BYTES = 64 * 2**20  # largest certificate; one with pictures of all its data has some megabytes


def digital_certificate_lines(path: str | Path) -> list[str]:
    """Describe a digital calibration certificate; CaptureError if the file is missing or no XML of its kind."""
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
    return [
        f"digital calibration certificate {found(*core, 'uniqueIdentifier')}, schema {root.get('schemaVersion')}",
        f"calibrated {found(*core, 'beginPerformanceDate')} to {found(*core, 'endPerformanceDate')}; "
        f"{quantities} quantities",
    ]
