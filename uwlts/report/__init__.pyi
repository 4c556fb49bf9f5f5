from . import plot as plot
from .calibration_pages import write_camera as write_camera, write_recalibration as write_recalibration
from .certificate import check_certificate as check_certificate
from .certificate_page import write_certificate as write_certificate
from .change_page import (
    write_change as write_change,
    write_domain_gap as write_domain_gap,
    write_registration as write_registration,
)
from .findings_page import write_findings as write_findings
from .frames import to_frame as to_frame
