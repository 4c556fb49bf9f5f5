"""Commands about a sensor by its description alone."""

from pathlib import Path

from uwlts.commands.options import Flag, app


@app.command
def design(sensor: str, *, medium: str) -> None:
    """Say what a sensor can do by the design formulas: resolution, line length, depth range, speckle limit.

    Example: uwlts design thesis --medium water

    Parameters
    ----------
    sensor
        Name or path of a sensor description.
    medium
        One of the sensor's media.
    """
    from uwlts.design_table import design_table, table_lines
    from uwlts.library import load_sensor

    described = load_sensor(sensor)
    print("\n".join(table_lines(design_table(described, described.medium(medium)))))


@app.command
def nominal(sensor: str, *, medium: str, out: Path, overwrite: Flag = False) -> None:
    """Write the calibration that a sensor would have if it were built exactly as described.

    Example: uwlts nominal thesis --medium water --out nominal.json

    Parameters
    ----------
    sensor
        Name or path of a sensor description.
    medium
        One of the sensor's media; the laser's window may turn the sheet in it.
    out
        Calibration file to write.
    overwrite
        Replace an existing file.
    """
    from uwlts.calibration.model import write_calibration
    from uwlts.calibration.nominal import nominal_calibration
    from uwlts.library import load_sensor

    described = load_sensor(sensor)
    write_calibration(out, nominal_calibration(described, described.medium(medium)), overwrite=overwrite)
    print(f"wrote {out}")
