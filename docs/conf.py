"""Settings of the documentation: Sphinx with MyST notebooks, which are executed when the site is built."""

import json
import re
import shutil
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.errors import ExtensionError

import twin
import uwlts
import uwlts.desk
import uwlts.report
import uwlts.thesis
from twin.cli import app as twin_app
from uwlts.cli import app as uwlts_app

ROOT = Path(__file__).resolve().parents[1]

# autodoc changes the annotations of pydantic's classes; models that are imported afterwards cannot be built.
for package in (uwlts, twin, uwlts.desk, uwlts.report, uwlts.thesis):
    for name in package.__all__:
        getattr(package, name)

project = "uwlts"
project_copyright = "the uwlts authors"
release = version = version_of("uwlts")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
source_suffix = {".md": "myst-nb"}
exclude_patterns = ["_build", "studies", "examples", "paper", "pictures", "static"]
html_theme = "pydata_sphinx_theme"
html_title = "uwlts"
html_theme_options = {
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "navigation_with_keys": False,
    # All pages stand in the left column, by chapters.
    "navbar_center": [],
    "footer_start": [],
    "footer_end": [],
}
html_sidebars = {"index": [], "**": ["globaltoc.html"]}
html_show_sourcelink = False
# Options keep both of their dashes.
smartquotes = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

# A tutorial is executed again when its text changed; a page that fails stops the build.
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "docs" / "_build" / "notebooks")
nb_execution_timeout = 1800
nb_execution_raise_on_error = True
nb_merge_streams = True

# A type is a word of the docstring, such as "name", which more than one attribute may have as its own name.
suppress_warnings = ["ref.python"]

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False
# Attributes as fields of their class: pydantic's fields are listed as members of their own.
napoleon_use_ivar = True


def _copy_pictures(app) -> None:
    """Make the pictures that pages show by name available to raw HTML."""
    shutil.copytree(ROOT / "docs" / "pictures", Path(app.outdir) / "pictures", dirs_exist_ok=True)


def _insert_commands(app, docname: str, source: list[str]) -> None:
    """Insert the help of all commands, without its table of contents: the page has one beside it."""
    if docname == "reference/commands":
        pages = [each.generate_docs(output_format="markdown", heading_level=2) for each in (uwlts_app, twin_app)]
        text = re.sub(
            r"^#+ Table of Contents\n.*?(?=^\*\*Commands)", "", "\n".join(pages), flags=re.DOTALL | re.MULTILINE
        )
        source[0] = source[0].replace("\nCOMMANDS\n", f"\n{text}\n")


def _link_notebook(app, docname: str, source: list[str]) -> None:
    """Add a link to a tutorial's notebook below its title."""
    if docname.startswith("tutorials/"):
        link = f'<p><a href="{docname.removeprefix("tutorials/")}.ipynb" download>Download as a notebook</a></p>'
        raw = f"\\1\n```{{raw}} html\n{link}\n```\n"
        source[0] = re.sub(r"^(# .*\n)", raw, source[0], count=1, flags=re.MULTILINE)


def _copy_notebooks(app, exception: Exception | None) -> None:
    """Put the executed notebooks, and the photographs that one of them reads, beside the pages of the tutorials."""
    tutorials = Path(app.outdir) / "tutorials"
    if exception is None and tutorials.is_dir():
        for notebook in (Path(app.outdir).parent / "jupyter_execute" / "tutorials").glob("*.ipynb"):
            _require_pictures(notebook)
            shutil.copy(notebook, tutorials)
        shutil.make_archive(str(tutorials / "etna"), "zip", ROOT / "tests" / "data", "etna")


def _require_pictures(notebook: Path) -> None:
    """Stop the build if a cell that shows a plot lacks a picture in its output, or one that shows a cloud its view."""
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        source = "".join(cell["source"])
        shown = [each.get("data", {}) for each in cell["outputs"]]
        if "plt.show()" in source and not any("image/png" in each for each in shown):
            raise ExtensionError(
                f"{notebook.name} shows no picture (an interrupted build? remove docs/_build) after:\n{source}"
            )
        views = sum("".join(each.get("text/html", "")).count('class="cloud-display"') for each in shown)
        if views < len(re.findall(r"cloud\.show\(", source)):
            raise ExtensionError(f"{notebook.name} shows no view of the cloud after:\n{source}")


def setup(app) -> None:
    """Connect the steps of this project's own."""
    app.connect("builder-inited", _copy_pictures)
    app.connect("source-read", _insert_commands)
    app.connect("source-read", _link_notebook)
    app.connect("build-finished", _copy_notebooks)
