"""Light from the laser through windows and water to the image: camera rays, sheet, scattering and frames."""
