"""The figures of a joint calibration that its file keeps, as plain numbers and lists."""

from typing import Any

import numpy as np

from uwlts.calibration.joint.estimate import Estimate
from uwlts.calibration.joint.observations import TARGET


def joint_figures(result: Estimate) -> dict[str, Any]:
    """Lens and window with their standard uncertainties, as other calibrations have them, and all of the estimate."""
    std, lens = result.std(), result.parameters.intrinsics.names
    prior = result.parameters.prior_std()
    camera: dict[str, Any] = {"std": {name: std[name] for name in lens}}
    if TARGET in result.noise:
        camera["sigma_px"] = result.noise[TARGET].sigma_px
    figures: dict[str, Any] = {
        "camera": camera,
        "joint": {
            "parameters": list(result.parameters.names),
            "values": result.values.tolist(),
            "std": list(std.values()),
            "std_before": [float(before) if np.isfinite(before) else None for before in prior],
            "covariance": result.covariance.tolist(),
            "described_sheet": {name: value.tolist() for name, value in vars(result.parameters.sheet).items()},
            "scatter_px": {kind: noise.sigma_px for kind, noise in result.noise.items()},
            "shared_variance": {kind: noise.together for kind, noise in result.noise.items()},
            "residuals": sum(len(r.values) for parts in result.residuals for r in parts),
            "strays": result.strays,
            "rounds": result.rounds,
            "stopped": result.stopped,
        },
    }
    if "window_distance" in std:
        figures["window"] = {"std_mm": std["window_distance"]}
    return figures
