"""The command that evaluates campaigns as the thesis does."""

from pathlib import Path

from uwlts.cli.options import Flag, app
from uwlts.model.errors import DescriptionError
from uwlts.runtime.console import progress_bar
from uwlts.storage.files import refuse_unsuitable


@app.command
def thesis(
    folder: Path,
    *,
    published: str = "thesis-tables",
    trials: int = 100,
    workers: int | None = None,
    joint: Flag = False,
    again: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Evaluate campaigns as the thesis does, by all its methods, and set its tables beside the results.

    The folder holds campaign-0, campaign-1, ..., each with the recordings of the whole evaluation; `twin reproduce`
    renders such. Writes report.html, summary.json, tables.csv and summary.md into it.

    Example: uwlts thesis runs/thesis

    Parameters
    ----------
    folder
        Folder of the campaigns.
    published
        Published tables: name or path of a TOML file.
    trials
        Trials of the Monte-Carlo propagation, at least 20, or 0 for none.
    workers
        Scans measured at a time; as many as there are processors unless given.
    joint
        Compare the joint calibration with the thesis's two ways instead, several campaigns at a time and without Monte
        Carlo; writes report.html and summary.json.
    again
        Evaluate campaigns anew that have results already.
    overwrite
        Replace an existing report.
    """
    from uwlts.thesis.campaign import campaign_folders
    from uwlts.thesis.evaluation import evaluate_campaign
    from uwlts.thesis.report import markdown, write_comparison
    from uwlts.thesis.tables import load_published

    if trials != 0 and trials < 20:
        raise DescriptionError(f"trials is {trials}: take 20 or more, or 0 for no Monte-Carlo propagation")
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if joint:
        _compare_jointly(folder, workers=workers, again=again, overwrite=overwrite)
        return
    tables, campaigns = load_published(published), campaign_folders(folder)
    refuse_unsuitable(folder / "report.html", overwrite=overwrite)
    results = []
    for campaign in campaigns:
        with progress_bar(f"evaluating {campaign.path.name}") as progress:
            results.append(
                evaluate_campaign(
                    campaign,
                    trials=trials,
                    workers=workers,
                    overwrite=again,
                    progress=lambda stage, done, total: progress(done, total),
                )
            )
    rows = write_comparison(folder, results, tables, overwrite=overwrite)
    print(markdown(rows, results), end="")
    print(f"wrote {folder / 'report.html'}, summary.json, tables.csv and summary.md")


def _compare_jointly(folder: Path, *, workers: int | None, again: bool, overwrite: bool) -> None:
    """Compare the joint calibration with the thesis's ways on all campaigns of a folder."""
    from uwlts.thesis.campaign import campaign_folders
    from uwlts.thesis.joint_comparison import compare_campaigns, summary_lines, write_joint_comparison

    for name in ("report.html", "summary.json"):
        refuse_unsuitable(folder / name, overwrite=overwrite)
    campaigns = campaign_folders(folder)
    with progress_bar("comparing campaigns") as progress:
        results = compare_campaigns(campaigns, workers=workers, again=again, progress=progress)
    print("\n".join(summary_lines(write_joint_comparison(folder, results, overwrite=overwrite))))
    print(f"wrote {folder / 'report.html'} and summary.json")
