"""The certificate of a calibration: what it was made from, where it holds, what lengths measured by it are worth."""

from uwlts.certificate.content import certificate_lines, certificate_of
from uwlts.certificate.page import certificate_page, refuse_unsuitable_certificate, write_certificate
from uwlts.certificate.seal import check_certificate, read_certificate

__all__ = [
    "certificate_lines",
    "certificate_of",
    "certificate_page",
    "check_certificate",
    "read_certificate",
    "refuse_unsuitable_certificate",
    "write_certificate",
]
