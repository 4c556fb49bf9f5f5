"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate.

Every name of the public interface is imported when it is first used, so that importing the package is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from uwlts._version import __version__ as __version__

if TYPE_CHECKING:
    from uwlts.alignment.align import AlignedTrajectory, align_trajectory
    from uwlts.calibration.calibrate import calibrate
    from uwlts.calibration.camera.photographs import CameraCalibration, calibrate_camera, write_camera
    from uwlts.calibration.joint.refresh import Refreshed, refresh
    from uwlts.calibration.model_comparison.comparison import Comparison, compare_models
    from uwlts.calibration.mount import calibrate_mount
    from uwlts.calibration.polynomial.polynomial_calibration_fit import PolynomialResult, calibrate_polynomials
    from uwlts.comparison.change import SurfaceChange, compare_clouds
    from uwlts.comparison.surface_mesh import mesh
    from uwlts.desk.guided import record_guided
    from uwlts.desk.operator_page import serve_desk
    from uwlts.desk.recording_view import watch
    from uwlts.doctor import Finding, examine
    from uwlts.errors import Error
    from uwlts.evaluation.evaluate import Evaluation, evaluate, write_evaluation
    from uwlts.evaluation.gauge import GaugeStudy, gauge_study
    from uwlts.hardware.guided.record import GuidedRecording
    from uwlts.hardware.scanning import scan
    from uwlts.inspection.features import Inspection
    from uwlts.inspection.inspect import inspect
    from uwlts.model.calibration import Calibration
    from uwlts.model.library import load_sensor
    from uwlts.model.mount import Mount
    from uwlts.model.polynomial_calibration import PolynomialCalibration
    from uwlts.model.sensor import Sensor
    from uwlts.model.trajectory import Trajectory
    from uwlts.optics.nominal import nominal
    from uwlts.reconstruction.reconstruct import ScanCloud, reconstruct
    from uwlts.reconstruction.verify import Verification, verify
    from uwlts.registration.register import RegisteredScans, register
    from uwlts.report import plot
    from uwlts.report.camera_page import write_camera_page
    from uwlts.report.campaign_page import Report, write_report
    from uwlts.report.certificate import check_certificate
    from uwlts.report.certificate_page import write_certificate
    from uwlts.report.change_page import write_change
    from uwlts.report.findings_page import write_findings
    from uwlts.report.inventory import describe, design
    from uwlts.report.model_comparison import write_models
    from uwlts.report.registration_page import write_registration
    from uwlts.storage.calibration_file import load_calibration, write_calibration
    from uwlts.storage.capture import Capture, Frame, open_capture
    from uwlts.storage.cloud import PointCloud
    from uwlts.storage.cloud_files import read_cloud, write_cloud
    from uwlts.storage.export_ import export
    from uwlts.storage.import_ import Imported, import_images
    from uwlts.storage.mesh_file import SurfaceMesh, write_mesh
    from uwlts.storage.mount_files import read_mount, write_mount
    from uwlts.storage.pose_files import read_poses, read_trajectory, write_poses, write_trajectory
    from uwlts.storage.truth import Truth, read_truth
    from uwlts.stripe import StripeOptions
    from uwlts.thesis.report import ThesisReport, evaluate_thesis


__all__ = [
    "AlignedTrajectory",
    "Calibration",
    "CameraCalibration",
    "Capture",
    "Comparison",
    "Error",
    "Evaluation",
    "Finding",
    "Frame",
    "GaugeStudy",
    "GuidedRecording",
    "Imported",
    "Inspection",
    "Mount",
    "PointCloud",
    "PolynomialCalibration",
    "PolynomialResult",
    "Refreshed",
    "RegisteredScans",
    "Report",
    "ScanCloud",
    "Sensor",
    "StripeOptions",
    "SurfaceChange",
    "SurfaceMesh",
    "ThesisReport",
    "Trajectory",
    "Truth",
    "Verification",
    "align_trajectory",
    "calibrate",
    "calibrate_camera",
    "calibrate_mount",
    "calibrate_polynomials",
    "check_certificate",
    "compare_clouds",
    "compare_models",
    "describe",
    "design",
    "evaluate",
    "evaluate_thesis",
    "examine",
    "export",
    "gauge_study",
    "import_images",
    "inspect",
    "load_calibration",
    "load_sensor",
    "mesh",
    "nominal",
    "open_capture",
    "plot",
    "read_cloud",
    "read_mount",
    "read_poses",
    "read_trajectory",
    "read_truth",
    "reconstruct",
    "record_guided",
    "refresh",
    "register",
    "scan",
    "serve_desk",
    "verify",
    "watch",
    "write_calibration",
    "write_camera",
    "write_camera_page",
    "write_certificate",
    "write_change",
    "write_cloud",
    "write_evaluation",
    "write_findings",
    "write_mesh",
    "write_models",
    "write_mount",
    "write_poses",
    "write_registration",
    "write_report",
    "write_trajectory",
]

_MODULES = {
    "AlignedTrajectory": "uwlts.alignment.align",
    "Calibration": "uwlts.model.calibration",
    "CameraCalibration": "uwlts.calibration.camera.photographs",
    "Capture": "uwlts.storage.capture",
    "Comparison": "uwlts.calibration.model_comparison.comparison",
    "Error": "uwlts.errors",
    "Evaluation": "uwlts.evaluation.evaluate",
    "Finding": "uwlts.doctor",
    "Frame": "uwlts.storage.capture",
    "GaugeStudy": "uwlts.evaluation.gauge",
    "GuidedRecording": "uwlts.hardware.guided.record",
    "Imported": "uwlts.storage.import_",
    "Inspection": "uwlts.inspection.features",
    "Mount": "uwlts.model.mount",
    "PointCloud": "uwlts.storage.cloud",
    "PolynomialCalibration": "uwlts.model.polynomial_calibration",
    "PolynomialResult": "uwlts.calibration.polynomial.polynomial_calibration_fit",
    "Refreshed": "uwlts.calibration.joint.refresh",
    "RegisteredScans": "uwlts.registration.register",
    "Report": "uwlts.report.campaign_page",
    "ScanCloud": "uwlts.reconstruction.reconstruct",
    "Sensor": "uwlts.model.sensor",
    "StripeOptions": "uwlts.stripe",
    "SurfaceChange": "uwlts.comparison.change",
    "SurfaceMesh": "uwlts.storage.mesh_file",
    "ThesisReport": "uwlts.thesis.report",
    "Trajectory": "uwlts.model.trajectory",
    "Truth": "uwlts.storage.truth",
    "Verification": "uwlts.reconstruction.verify",
    "align_trajectory": "uwlts.alignment.align",
    "calibrate": "uwlts.calibration.calibrate",
    "calibrate_camera": "uwlts.calibration.camera.photographs",
    "calibrate_mount": "uwlts.calibration.mount",
    "calibrate_polynomials": "uwlts.calibration.polynomial.polynomial_calibration_fit",
    "check_certificate": "uwlts.report.certificate",
    "compare_clouds": "uwlts.comparison.change",
    "compare_models": "uwlts.calibration.model_comparison.comparison",
    "describe": "uwlts.report.inventory",
    "design": "uwlts.report.inventory",
    "evaluate": "uwlts.evaluation.evaluate",
    "evaluate_thesis": "uwlts.thesis.report",
    "examine": "uwlts.doctor",
    "export": "uwlts.storage.export_",
    "gauge_study": "uwlts.evaluation.gauge",
    "import_images": "uwlts.storage.import_",
    "inspect": "uwlts.inspection.inspect",
    "load_calibration": "uwlts.storage.calibration_file",
    "load_sensor": "uwlts.model.library",
    "mesh": "uwlts.comparison.surface_mesh",
    "nominal": "uwlts.optics.nominal",
    "open_capture": "uwlts.storage.capture",
    "plot": "uwlts.report.plot",
    "read_cloud": "uwlts.storage.cloud_files",
    "read_mount": "uwlts.storage.mount_files",
    "read_poses": "uwlts.storage.pose_files",
    "read_trajectory": "uwlts.storage.pose_files",
    "read_truth": "uwlts.storage.truth",
    "reconstruct": "uwlts.reconstruction.reconstruct",
    "record_guided": "uwlts.desk.guided",
    "refresh": "uwlts.calibration.joint.refresh",
    "register": "uwlts.registration.register",
    "scan": "uwlts.hardware.scanning",
    "serve_desk": "uwlts.desk.operator_page",
    "verify": "uwlts.reconstruction.verify",
    "watch": "uwlts.desk.recording_view",
    "write_calibration": "uwlts.storage.calibration_file",
    "write_camera": "uwlts.calibration.camera.photographs",
    "write_camera_page": "uwlts.report.camera_page",
    "write_certificate": "uwlts.report.certificate_page",
    "write_change": "uwlts.report.change_page",
    "write_cloud": "uwlts.storage.cloud_files",
    "write_evaluation": "uwlts.evaluation.evaluate",
    "write_findings": "uwlts.report.findings_page",
    "write_mesh": "uwlts.storage.mesh_file",
    "write_models": "uwlts.report.model_comparison",
    "write_mount": "uwlts.storage.mount_files",
    "write_poses": "uwlts.storage.pose_files",
    "write_registration": "uwlts.report.registration_page",
    "write_report": "uwlts.report.campaign_page",
    "write_trajectory": "uwlts.storage.pose_files",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(_MODULES[name])
    value = module if name == "plot" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
