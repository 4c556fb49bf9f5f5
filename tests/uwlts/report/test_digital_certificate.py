"""Digital calibration certificate: order of elements as in the schema, values, and refused administrative data.

``ORDER`` lists the elements of dcc.xsd 3.2.0 and SI_Format.xsd 2.1.0 that are used, in the order of the schemas. They
themselves (LGPL-3) are not copied into the project.
"""

import re
import xml.etree.ElementTree as ET
from decimal import Decimal

import numpy as np
import pytest

import uwlts
from tests.system.in_process import run_program
from tests.uwlts.joint_views import joint_calibration
from uwlts.cli import app
from uwlts.errors import CaptureError, DescriptionError, EvaluationError
from uwlts.model.sensor import Medium
from uwlts.report.certificate import Certificate, CertifiedFile, ParameterRow, Validity
from uwlts.report.certificate_volume import LengthUncertainty
from uwlts.report.digital_certificate import DCC, SI, UNITS, _format_decimal, digital_certificate, load_administration

ADMINISTRATION = """
identifier = "UW-7"
begin = 2026-03-02
end = 2026-03-03

[laboratory]
name = "Laboratory <A & B>"
country = "BR"
city = "Florianopolis"
street = "Rua 1"

[customer]
name = "Operator"
country = "NO"
city = "Stavanger"
e_mail = "a@example.org"

[item]
serial_number = "7"
manufacturer = "Maker"

[[persons]]
name = "A. Silva"
role = "head"
main_signer = true
"""
EQUIPMENT = """
[[equipment]]
role = "target"
name = "etched circles <7>"
serial_number = "T-7"
certificate = "2026-1"
manufacturer = "Maker of targets"

[[equipment]]
role = "thermometer"
name = "PT100"
model = "P1"
certificate = "2026-2"
"""
TRACEABLE = 'traceability = "By DAkkS D-K-1 to the SI"\n'

ORDER = {
    "digitalCalibrationCertificate": "administrativeData! measurementResults!",
    "administrativeData": "dccSoftware! coreData! items! calibrationLaboratory! respPersons! customer! statements",
    "dccSoftware": "software!",
    "software": "name! release!",
    "coreData": "countryCodeISO3166_1! usedLangCodeISO639_1! mandatoryLangCodeISO639_1! uniqueIdentifier! "
    "beginPerformanceDate! endPerformanceDate! performanceLocation! issueDate",
    "items": "item!",
    "item": "name! manufacturer! model identifications!",
    "manufacturer": "name!",
    "identifications": "identification!",
    "identification": "issuer! value! name",
    "calibrationLaboratory": "contact!",
    "contact": "name! eMail location!",
    "customer": "name! eMail location!",
    "location": "city countryCode postCode street",
    "respPersons": "respPerson!",
    "respPerson": "person! role mainSigner",
    "person": "name!",
    "statements": "statement!",
    "statement": "traceable declaration",
    "declaration": "content!",
    "measurementResults": "measurementResult!",
    "measurementResult": "name! usedMethods measuringEquipments influenceConditions results!",
    "usedMethods": "usedMethod!",
    "usedMethod": "name! norm",
    "measuringEquipments": "measuringEquipment!",
    "measuringEquipment": "name! manufacturer model identifications",
    "influenceConditions": "influenceCondition!",
    "influenceCondition": "name! data!",
    "results": "result!",
    "result": "name! data!",
    "data": "quantity!",
    "quantity": "name real!",
    "real": "value! unit! expandedUnc",
    "expandedUnc": "uncertainty! coverageFactor! coverageProbability! distribution",
    "name": "content!",
}
"""Children of each element in their order; those with ! are required, and all may be repeated."""
DECIMAL = r"[-+]?((\d*\.\d+)|(\d+\.\d*)|(\d+\.?))([Ee][-+]?\d+)?"


@pytest.fixture
def administration(tmp_path):
    (tmp_path / "administration.toml").write_text(ADMINISTRATION, encoding="utf-8")
    return tmp_path / "administration.toml"


def certificate(**changes):
    """A small certificate with all kinds of entries."""
    units = [
        ("f", "px", 2440.0132856416235, 0.18),
        ("stage_scale", "µm/m", -3.0, 50.0),
        ("glass_index", "", 1.52, None),
    ]
    rows = [ParameterRow(name=name, words=name, unit=u, value=v, std=s, std_before=None) for name, u, v, s in units]
    file = CertifiedFile(file="c.json", sha256="ab" * 32, digest="cd" * 8, date=None, software=None)
    medium = Medium(kind="fresh", temperature_c=25.0)
    ends = {"camera_depth_mm": (320.0, 480.0), "y_mm": (-97.0, 95.0), "z_mm": (-67.0, 131.0)}
    volume = Validity(
        name="water",
        medium=medium,
        through_window=True,
        index=1.3312,
        index_std=1e-5,
        outline_mm=(),
        stripe_points=9,
        **ends,
    )
    content = {"format": "uwlts-certificate", "version": 1, "sensor": "thesis", "issued": "2026-03-04T05:06:07+00:00"}
    content |= {
        "software": "uwlts 1.2",
        "calibration": file,
        "wavelength_nm": 635.0,
        "made_from": {},
        "parameters": rows,
    }
    content |= {"validity": (volume,), "scatter_px": {}, "shared_variance": {}, "residuals": 1}
    content |= {"strays": 0, "images": (), "lengths": (LengthUncertainty("Y", 150.0, 0.0118, 0.0306),)}
    content |= {"cannot_tell": ("f is weakly known",), "sha256": "ef" * 32}
    return Certificate.model_validate(content | changes)


def root_of(administration, **changes):
    return ET.fromstring(digital_certificate(certificate(**changes), load_administration(administration)).encode())


def check_order(element):
    """Check an element and all below it against the schema's order and required elements; return their number."""
    name = element.tag.partition("}")[2]
    if name not in ORDER:
        assert len(element) == 0, name
        assert element.text.strip() == element.text != "", name
        return 1
    listed = ORDER[name].split()
    names = [each.rstrip("!") for each in listed]
    found = [child.tag.partition("}")[2] for child in element]
    assert set(found) <= set(names), name
    assert [*map(names.index, found)] == sorted(map(names.index, found)), name
    assert {each.rstrip("!") for each in listed if each.endswith("!")} <= set(found), name
    return 1 + sum(map(check_order, element))


def quantities(root):
    """Value, unit and expanded uncertainty of each quantity by its name."""
    found = {}
    for each in root.iter(f"{{{DCC}}}quantity"):
        real = each.find(f"{{{SI}}}real")
        texts = [real.findtext(f"{{{SI}}}{name}") for name in ("value", "unit")]
        uncertainty = real.find(f"{{{SI}}}expandedUnc")
        expanded = None if uncertainty is None else uncertainty.findtext(f"{{{SI}}}uncertainty")
        for number in (texts[0], expanded):
            assert number is None or re.fullmatch(DECIMAL, number)
        if uncertainty is not None:
            assert uncertainty.findtext(f"{{{SI}}}coverageFactor") == "2"
            assert uncertainty.findtext(f"{{{SI}}}coverageProbability") == "0.95"
        found.setdefault(each.findtext(f"{{{DCC}}}name/{{{DCC}}}content"), []).append(
            (float(texts[0]), texts[1], expanded and float(expanded))
        )
    return found


def test_elements_have_the_order_of_the_schema(administration):
    root = root_of(administration)
    assert root.tag == f"{{{DCC}}}digitalCalibrationCertificate"
    assert root.get("schemaVersion") == "3.2.0"
    assert check_order(root) > 200
    texts = [each.text for each in root.iter()]
    for text in ("UW-7", "Laboratory <A & B>", "2026-03-02", "2026-03-04", "ef" * 32, "ab" * 32, "f is weakly known"):
        assert text in texts, text


def test_values_are_those_of_the_certificate(administration):
    root = root_of(administration)
    found = quantities(root)
    assert found["f (f) in pixels"] == [(2440.01, r"\one", 0.36)]
    assert found["stage_scale (stage_scale)"] == [(0.0, r"\micro\metre\metre\tothe{-1}", 100.0)]
    assert found["glass_index (glass_index)"] == [(1.52, r"\one", None)]
    lengths = [(150.0, r"\milli\metre", each) for each in (0.012, 0.031)]
    assert found["length of 150 mm along Y"] == lengths
    assert found["refractive index relative to air"] == [(1.3312, r"\one", 2e-5)]
    assert found["temperature"] == [(25.0, r"\degreecelsius", None)]
    assert found["largest Z in water"] == [(131.0, r"\milli\metre", None)]


@pytest.mark.parametrize("seed", range(20))
def test_digits_are_those_of_the_uncertainty(seed):
    """Two significant digits of the uncertainty, and as many decimals of the value: both are within half a digit."""
    rng = np.random.default_rng([98, seed])
    expanded, value = 10 ** rng.uniform(-8, 3), rng.uniform(-1, 1) * 10 ** rng.uniform(-2, 4)
    texts = _format_decimal(expanded, expanded), _format_decimal(value, expanded)
    digit = Decimal(f"{expanded:.1e}").as_tuple().exponent
    for text, exact in zip(texts, (expanded, value), strict=True):
        assert re.fullmatch(DECIMAL, text)
        assert abs(float(text) - exact) <= 0.5001 * 10.0**digit
        assert Decimal(text).as_tuple().exponent == min(digit, 0)
    assert _format_decimal(0.0996, 0.0996) == "0.10" and _format_decimal(1234.4, 120.0) == "1230"
    assert _format_decimal(1.52, None) == "1.52"


CIRCLES, STEP = {"target": {"kind": "circles"}}, {"step_captures": [{}]}


def statement(root):
    """Return whether the certificate is traceable, and the sentence."""
    first = root.find(f".//{{{DCC}}}statement")
    return first.findtext(f"{{{DCC}}}traceable"), first.findtext(f"{{{DCC}}}declaration/{{{DCC}}}content")


@pytest.mark.parametrize(
    ("stated", "used", "expected"),
    [
        (TRACEABLE + ADMINISTRATION + EQUIPMENT, CIRCLES, ("true", "By DAkkS D-K-1 to the SI")),
        (ADMINISTRATION + EQUIPMENT, CIRCLES, ("false", "no statement of traceability")),
        (TRACEABLE + ADMINISTRATION + EQUIPMENT, STEP, ("false", "no certificate of the step standard")),
        (TRACEABLE + ADMINISTRATION, {"target": {}}, ("false", "no certificate of the thermometer")),
        (TRACEABLE + ADMINISTRATION, CIRCLES, ("false", "the target, no certificate of the th")),
    ],
)
def test_traceability_needs_a_statement_and_a_certificate_of_all_equipment(administration, stated, used, expected):
    administration.write_text(stated, encoding="utf-8")
    root = root_of(administration, made_from=used)
    check_order(root)
    traceable, sentence = statement(root)
    assert traceable == expected[0] and expected[1] in sentence


def test_equipment_and_kinds_of_quantities_are_marked(administration):
    administration.write_text(ADMINISTRATION + EQUIPMENT, encoding="utf-8")
    root = root_of(administration)
    equipment = list(root.iter(f"{{{DCC}}}measuringEquipment"))
    assert [each.get("refType") for each in equipment] == ["basic_measurementStandard"] * 2
    texts = [each.text for each in root.iter()]
    for text in ("target: etched circles <7>", "T-7", "2026-1", "Maker of targets", "thermometer: PT100", "P1"):
        assert text in texts, text
    kinds = {
        each.findtext(f"{{{DCC}}}name/{{{DCC}}}content"): each.get("refType")
        for each in root.iter(f"{{{DCC}}}quantity")
    }
    assert kinds["length of 150 mm along Y"] == "basic_nominalValue"
    assert kinds["f (f) in pixels"] == "basic_measuredValue"
    assert kinds["temperature"] == "basic_temperature"
    serial = [each for each in root.iter(f"{{{DCC}}}identification") if each.get("refType") == "basic_serialNumber"]
    assert len(serial) == 2


@pytest.fixture
def written(administration, tmp_path):
    text = digital_certificate(certificate(), load_administration(administration))
    (tmp_path / "c.xml").write_text(text, encoding="utf-8")
    return tmp_path / "c.xml"


def test_info_describes_it(written):
    text = uwlts.describe(written)
    assert "digital calibration certificate UW-7, schema 3.2.0" in text and text.endswith("quantities")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<a>", "is not valid XML"),
        ("<a/>", "no digital calibration certificate"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "has a document type"),
    ],
)
def test_other_xml_is_refused(tmp_path, text, said):
    (tmp_path / "a.xml").write_text(text, encoding="utf-8")
    with pytest.raises(CaptureError, match=said):
        uwlts.describe(tmp_path / "a.xml")
    with pytest.raises(CaptureError):
        uwlts.describe(tmp_path / "missing.xml")


def test_all_units_of_parameters_are_known():
    from uwlts.model import parameter_keys

    units = {
        each.quantity.unit
        for group in vars(parameter_keys).values()
        if isinstance(group, type) and hasattr(group, "__members__")
        for each in group
    }
    assert len(units) > 3
    assert units <= UNITS.keys()


def test_an_unknown_unit_is_refused(administration):
    row = ParameterRow(name="a", words="a", unit="furlong", value=1.0, std=None, std_before=None)
    with pytest.raises(EvaluationError, match="the unit 'furlong' of a"):
        root_of(administration, parameters=(row,))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('country = "BR"', 'country = "Brazil"', "laboratory.country"),
        ('identifier = "UW-7"', 'identifier = ""', "identifier"),
        ("end = 2026-03-03", "end = 2026-03-01", "before it begins"),
        ("[[persons]]", "[[people]]", "persons: missing"),
    ],
)
def test_wrong_administrative_data_are_refused(administration, old, new, said):
    administration.write_text(ADMINISTRATION.replace(old, new), encoding="utf-8")
    with pytest.raises(DescriptionError, match=said):
        load_administration(administration)


def test_the_command_writes_it_beside_the_page(administration, thesis, tmp_path):
    joint_calibration(thesis).save(tmp_path / "water.json")
    words = ["certificate", tmp_path / "water.json", "--out", tmp_path / "c.html", "--administration", administration]
    done = run_program(app, "uwlts", *words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(f"wrote {tmp_path / 'c.xml'}\n")
    root = ET.fromstring((tmp_path / "c.xml").read_bytes())
    check_order(root)
    lengths = [each for name, values in quantities(root).items() if name.startswith("length of") for each in values]
    assert len(lengths) > 10 and all(expanded > 0 for *_, expanded in lengths)
    assert run_program(app, "uwlts", *words).returncode == 2
