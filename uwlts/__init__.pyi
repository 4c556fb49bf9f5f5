from .alignment.align import AlignedTrajectory as AlignedTrajectory, align_trajectory as align_trajectory
from .calibration.calibrate import calibrate as calibrate
from .calibration.camera.photographs import (
    CameraCalibration as CameraCalibration,
    calibrate_camera as calibrate_camera,
    write_camera as write_camera,
)
from .calibration.joint.refresh import Refreshed as Refreshed, refresh as refresh
from .calibration.model_comparison.comparison import Comparison as Comparison, compare_models as compare_models
from .calibration.mount.calibrate import calibrate_mount as calibrate_mount
from .calibration.polynomial.polynomial_calibration_fit import (
    PolynomialResult as PolynomialResult,
    calibrate_polynomials as calibrate_polynomials,
)
from .comparison.change import SurfaceChange as SurfaceChange, compare_clouds as compare_clouds
from .comparison.surface_mesh import mesh as mesh
from .desk.guided import record_guided as record_guided
from .desk.operator_page import serve_desk as serve_desk
from .desk.recording_view import watch as watch
from .doctor import Finding as Finding, examine as examine
from .errors import Error as Error
from .evaluation.evaluate import Evaluation as Evaluation, evaluate as evaluate, write_evaluation as write_evaluation
from .evaluation.gauge import GaugeStudy as GaugeStudy, gauge_study as gauge_study
from .hardware.guided.record import GuidedRecording as GuidedRecording
from .hardware.scanning import scan as scan
from .inspection.features import Inspection as Inspection
from .inspection.inspect import inspect as inspect
from .model.calibration import Calibration as Calibration
from .model.library import load_sensor as load_sensor
from .model.mount import Mount as Mount
from .model.polynomial_calibration import PolynomialCalibration as PolynomialCalibration
from .model.sensor import Sensor as Sensor
from .model.trajectory import Trajectory as Trajectory
from .optics.nominal import nominal as nominal
from .reconstruction.reconstruct import reconstruct as reconstruct
from .reconstruction.verify import Verification as Verification, verify as verify
from .registration.register import RegisteredScans as RegisteredScans, register as register
from .report import plot as plot
from .report.camera_page import write_camera_page as write_camera_page
from .report.campaign_page import Report as Report, write_report as write_report
from .report.certificate import check_certificate as check_certificate
from .report.certificate_page import write_certificate as write_certificate
from .report.change_page import write_change as write_change
from .report.findings_page import write_findings as write_findings
from .report.inventory import describe as describe, design as design
from .report.model_comparison import write_models as write_models
from .report.registration_page import write_registration as write_registration
from .storage.calibration_file import load_calibration as load_calibration, write_calibration as write_calibration
from .storage.capture import Capture as Capture, Frame as Frame, open_capture as open_capture
from .storage.cloud import PointCloud as PointCloud
from .storage.cloud_files import read_cloud as read_cloud, write_cloud as write_cloud
from .storage.export_ import export as export
from .storage.import_ import Imported as Imported, import_images as import_images
from .storage.mesh_file import SurfaceMesh as SurfaceMesh, write_mesh as write_mesh
from .storage.mount_files import read_mount as read_mount, write_mount as write_mount
from .storage.pose_files import (
    read_poses as read_poses,
    read_trajectory as read_trajectory,
    write_poses as write_poses,
    write_trajectory as write_trajectory,
)
from .storage.truth import Truth as Truth, read_truth as read_truth
from .stripe import StripeOptions as StripeOptions
from .thesis.report import ThesisReport as ThesisReport, evaluate_thesis as evaluate_thesis
