from . import desk as desk, report as report
from .alignment.align import align_trajectory as align_trajectory
from .calibration.calibrate import calibrate as calibrate
from .calibration.camera.photographs import calibrate_camera as calibrate_camera
from .calibration.mount.calibrate_mount import calibrate_mount as calibrate_mount
from .calibration.polynomial.polynomial_calibration import calibrate_polynomials as calibrate_polynomials
from .comparison.change import compare_clouds as compare_clouds
from .desk.scan import scan as scan
from .doctor import examine as examine
from .errors import Error as Error
from .evaluation.evaluate import Evaluation as Evaluation, evaluate as evaluate
from .inspection.features import Inspection as Inspection
from .inspection.pipe import inspect_pipe as inspect_pipe
from .inspection.weld import inspect_weld as inspect_weld
from .model.calibration import Calibration as Calibration, PolynomialCalibration as PolynomialCalibration
from .model.library import load_sensor as load_sensor
from .model.mount import Mount as Mount
from .model.sensor import Sensor as Sensor
from .model.trajectory import Trajectory as Trajectory
from .optics.nominal import design as design, nominal as nominal
from .radiometry.fit import fit_radiometry as fit_radiometry
from .radiometry.result import Radiometry as Radiometry
from .recalibration.recalibrate import recalibrate as recalibrate
from .reconstruction.reconstruct import reconstruct as reconstruct
from .reconstruction.verify import verify as verify
from .registration.register import register as register
from .report import plot as plot
from .report.file_description import describe as describe, read as read
from .storage.capture import Capture as Capture
from .storage.cloud import PointCloud as PointCloud
from .storage.export_ import export as export
from .storage.import_.folder import import_images as import_images
from .storage.import_.template import write_template as write_template
from .stripe import StripeOptions as StripeOptions
