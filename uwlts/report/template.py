"""Pages from templates, all of one style."""

from importlib.resources import files
from typing import Any

from jinja2 import Environment
from markupsafe import Markup

from uwlts.report.numbers import typographic


def rendered(package: str, name: str, **values: Any) -> str:
    """The page that a package's template makes of values; the template puts ``style`` before its own."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["minus"] = typographic
    template = environment.from_string(files(package).joinpath(name).read_text(encoding="utf-8"))
    style = files("uwlts.report").joinpath("style.css").read_text(encoding="utf-8")
    return template.render(style=Markup(style), **values)
