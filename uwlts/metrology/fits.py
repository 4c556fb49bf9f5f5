"""All fits in one place: plane, line, sphere, cylinder, and the robust variant of each."""

from uwlts.metrology.cylinder_fit import CylinderFit, fit_cylinder
from uwlts.metrology.flat_fits import LineFit, PlaneFit, fit_line, fit_plane
from uwlts.metrology.robust_fit import VDI_OUTLIER_SHARE, RobustFit, fit_robustly
from uwlts.metrology.sphere_fit import SphereFit, fit_sphere

__all__ = [
    "VDI_OUTLIER_SHARE",
    "CylinderFit",
    "LineFit",
    "PlaneFit",
    "RobustFit",
    "SphereFit",
    "fit_cylinder",
    "fit_line",
    "fit_plane",
    "fit_robustly",
    "fit_sphere",
]
