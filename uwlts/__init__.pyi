from . import report as report
from .alignment.align import align_trajectory as align_trajectory
from .calibration.calibrate import calibrate as calibrate
from .calibration.camera.photographs import calibrate_camera as calibrate_camera
from .calibration.joint.refresh import refresh as refresh
from .calibration.model_comparison.comparison import compare_models as compare_models
from .calibration.mount.calibrate import calibrate_mount as calibrate_mount
from .calibration.polynomial.polynomial_calibration_fit import calibrate_polynomials as calibrate_polynomials
from .comparison.change import compare_clouds as compare_clouds
from .comparison.surface_mesh import mesh as mesh
from .desk.guided import record_guided as record_guided
from .desk.operator_page import serve_desk as serve_desk
from .desk.recording_view import watch as watch
from .doctor import examine as examine
from .errors import Error as Error
from .evaluation.evaluate import Evaluation as Evaluation, evaluate as evaluate
from .evaluation.gauge import gauge_study as gauge_study
from .hardware.scanning import scan as scan
from .inspection.features import Inspection as Inspection
from .inspection.flat import inspect_flange as inspect_flange, inspect_gap as inspect_gap, inspect_step as inspect_step
from .inspection.pipe import inspect_pipe as inspect_pipe
from .inspection.weld import inspect_weld as inspect_weld
from .model.calibration import Calibration as Calibration
from .model.library import load_sensor as load_sensor
from .model.mount import Mount as Mount
from .model.polynomial_calibration import PolynomialCalibration as PolynomialCalibration
from .model.sensor import Sensor as Sensor
from .model.trajectory import Trajectory as Trajectory
from .optics.nominal import nominal as nominal
from .reconstruction.reconstruct import ScanCloud as ScanCloud, reconstruct as reconstruct
from .reconstruction.verify import verify as verify
from .registration.register import register as register
from .report import plot as plot
from .report.inventory import describe as describe, design as design
from .storage.any_file import read as read
from .storage.capture import Capture as Capture
from .storage.cloud import PointCloud as PointCloud
from .storage.export_ import export as export
from .storage.import_.folder import import_images as import_images
from .storage.mesh_file import SurfaceMesh as SurfaceMesh
from .stripe import StripeOptions as StripeOptions
from .thesis.report import evaluate_thesis as evaluate_thesis
