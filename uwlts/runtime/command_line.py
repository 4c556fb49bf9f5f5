"""Commands made from public functions, with the functions' parameters, types, defaults and help.

A command has a body, which is called with a `Call` of the function and with the options that only the body has.
Parameters that cannot be given as text, such as arrays and opened files, are not options.
"""

import ast
import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, cached_property, reduce
from operator import or_
from pathlib import Path
from types import ModuleType, NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from cyclopts import App, Group, Parameter

from uwlts._version import __version__
from uwlts.argument_types import union_members
from uwlts.errors import make_printable
from uwlts.runtime.console import SWITCHES, progress_bar, replace_by_options, warn

_LISTENERS = ("progress", "report", "warn")  # parameters through which functions report; a command prints the reports


class PathText(str):
    """Text of a path, an option's type where a function takes both `str` and `Path`; help shows it as PATH."""


PathText.__name__ = "Path"
_WORDS = (PathText, str, int, float, bool)

Job = Literal["Design", "Simulate", "Calibrate", "Scan", "Reconstruct", "Inspect", "Files"]
"""Groups of commands in the help, in its order."""
JOBS = {job: Group(job, sort_key=place) for place, job in enumerate(get_args(Job))}
_PROGRAM = Group("Program", sort_key=len(JOBS))
_ADVANCED = Group("Advanced", sort_key=1)
"""Options of a command that are neither required, nor outputs, nor part of its examples."""


def make_program(name: str, title: str) -> App:
    """Return a program without commands, with the options for its version, its messages and completion by the shell."""
    # The list of commands has no markup, and is shown earlier without Markdown's libraries.
    app = App(name=name, help=title, version=__version__, help_format="plaintext", group_commands=JOBS["Files"])
    app.register_install_completion_command(group=_PROGRAM, help="Install completion of commands for your shell.")
    for names, text in SWITCHES.values():
        # `uwlts.runtime.console.run` takes them out of every command line; alone they do nothing.
        app.command(lambda: None, name=names, group=_PROGRAM, help=text)
    for flag in ("--help", "--version"):
        app[flag].group = _PROGRAM
    return app


@dataclass(frozen=True)
class Before:
    """Check of a command's output before the work, as an annotation of its option."""

    check: Callable[..., None]
    """Called with the path and ``overwrite``."""


@dataclass(frozen=True)
class Shortcuts:
    """Options that set entries of a function's settings, such as ``--stripe-method`` for an entry of ``stripe``."""

    setting: str
    options: Mapping[str, Any]
    """Annotations of the options by the names of the entries; the options' names are ``SETTING_ENTRY``."""


def command_from(
    app: App,
    package: ModuleType,
    function: str,
    *,
    job: Job,
    also: Sequence[tuple[ModuleType, str]] = (),
    shortcuts: Shortcuts | None = None,
    summary: str | None = None,
) -> Callable[[Callable[..., None]], "DerivedCommand"]:
    """Make a command from a public function of a package; the decorated function is the body and names the command.

    The body takes a `Call`, and the command's additional options as parameters. Parameters without an annotation are
    taken from ``function`` or ``also``, with default and description.

    The function is imported when the command is run or its own help is shown. ``job`` is the group in the help,
    ``also`` lists further functions (package, name) whose parameters the body may have. ``summary`` replaces the prose
    of the docstring in the help.
    """

    def register(body: Callable[..., None]) -> DerivedCommand:
        made = DerivedCommand(package, function, body, also, shortcuts, summary)
        name = body.__name__.strip("_").replace("_", "-")
        place = f"{body.__module__}:{body.__name__}"
        app.command(place, name=name, help=made.__doc__, help_format="markdown", group=JOBS[job])
        return made

    return register


@dataclass(frozen=True)
class Call:
    """Function of a command with the arguments from the command line."""

    function: Callable[..., Any]
    parameters: Mapping[str, inspect.Parameter]
    given: dict[str, Any]
    """Arguments by name, in the types of the function's parameters; those for ``*args`` have the name ``*``."""
    title: str  # title of the progress bar

    def __call__(self, **more: Any) -> Any:
        """Call the function with the given and further arguments, and show its progress."""
        heard = {name: listen for name, listen in (("report", say), ("warn", warn)) if name in self.parameters}
        given = self.given | more | heard
        with progress_bar(self.title) if "progress" in self.parameters else nullcontext() as progress:
            given |= {} if progress is None else {"progress": progress}
            return self.function(*given.pop("*", ()), **given)


class DerivedCommand:
    """A command in the form that cyclopts needs: a callable with a signature and a docstring."""

    def __init__(
        self,
        package: ModuleType,
        function: str,
        body: Callable[..., None],
        also: Sequence[tuple[ModuleType, str]],
        shortcuts: Shortcuts | None,
        summary: str | None,
    ):
        self._package, self._function, self._also, self._shortcuts = package, function, also, shortcuts
        self._body = body
        self.__name__ = body.__name__
        prose = summary or _convert_help(_split(docstring(package, function))[0], descriptions(package, function))
        self.__doc__ = f"{prose.rstrip()}\n\n{inspect.getdoc(body)}"

    @property
    def function(self) -> Callable[..., Any]:
        """The function of the command."""
        return getattr(self._package, self._function)

    @property
    def __annotations__(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {name: one.annotation for name, one in self.__signature__.parameters.items()}

    @cached_property
    def _taken(self) -> dict[str, inspect.Parameter]:
        """Return the parameters of the function, with their types."""
        hints, parameters = get_type_hints(self.function), inspect.signature(self.function).parameters
        return {name: one.replace(annotation=hints[name]) for name, one in parameters.items()}

    @cached_property
    def _own(self) -> dict[str, inspect.Parameter]:
        """Return the body's parameters after the call; those without an annotation are taken from the functions."""
        parameters = dict(list(inspect.signature(self._body, eval_str=True).parameters.items())[1:])
        like = [name for name, one in parameters.items() if one.annotation is one.empty and name not in self._taken]
        # Of several functions with the option, the first one counts.
        sources = [_list_options(*function) for function in reversed(self._also)] if like else []
        options = {name: one for source in sources for name, one in source.items()}
        for name in like:
            parameters[name] = parameters[name].replace(
                annotation=options[name].annotation, default=options[name].default
            )
        return parameters

    @cached_property
    def __signature__(self) -> inspect.Signature:
        taken, options = self._taken, _list_options(self._package, self._function)
        if self._shortcuts is not None:
            for entry, hint in self._shortcuts.options.items():
                name = f"{self._shortcuts.setting}_{entry}"
                options[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=hint)
        made = [*options.values(), *(one for name, one in self._own.items() if name not in taken)]
        for place, one in enumerate(made):
            if not self._is_common(one):
                made[place] = one.replace(annotation=Annotated[one.annotation, Parameter(group=_ADVANCED)])
        # By kind, and parameters without a default first.
        made.sort(key=lambda one: (one.kind, one.default is not one.empty))
        return inspect.Signature(made, return_annotation=None)

    def _is_common(self, one: inspect.Parameter) -> bool:
        """Return whether an option is required, an output or its replacement, or part of the command's examples."""
        if one.default is one.empty or one.kind is not one.KEYWORD_ONLY or one.name == "overwrite":
            return True
        examples = " ".join(re.findall(r"Example: .*", self.__doc__ or ""))
        is_output = any(isinstance(each, Before) for each in getattr(one.annotation, "__metadata__", ()))
        return is_output or re.search(rf"--{one.name.replace('_', '-')}\b(?!-)", examples) is not None

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        """Check the outputs, and run the body."""
        bound = self.__signature__.bind(*args, **kwargs)
        bound.arguments.update({name: _convert_text(value) for name, value in bound.arguments.items()})
        explicit = dict(bound.arguments)
        bound.apply_defaults()
        for name, one in self.__signature__.parameters.items():
            checks = [each for each in getattr(one.annotation, "__metadata__", ()) if isinstance(each, Before)]
            for before in checks if bound.arguments[name] is not None else ():
                before.check(Path(bound.arguments[name]), overwrite=bound.arguments.get("overwrite", False))
        given = {name: self._convert_value(name, value) for name, value in explicit.items() if name in self._taken}
        if any(one.kind is one.VAR_KEYWORD for one in self._taken.values()):
            given |= {name: value for name, value in explicit.items() if name in self._own}
        if self._shortcuts is not None:
            setting, entries = self._shortcuts.setting, self._shortcuts.options
            settings = parse_settings(setting, explicit.get(setting, ()))
            settings |= {each: explicit[name] for each in entries if (name := f"{setting}_{each}") in explicit}
            given |= {setting: settings} if settings else {}
        for name, one in self._taken.items():
            if one.kind is one.VAR_POSITIONAL and name in given:
                given["*"] = given.pop(name)
        first = next((value for value in explicit.values() if isinstance(value, str | Path)), "")
        title = f"{self.function.__name__.replace('_', ' ')} {Path(first).name}".strip()
        call = Call(self.function, self._taken, given, title)
        self._body(call, **{name: bound.arguments[name] for name in self._own})

    def _convert_value(self, name: str, value: Any) -> Any:
        """Return a value as the function takes it: a single literal word is not a tuple."""
        kinds = union_members(self._taken[name].annotation)
        alone = [word for kind in kinds if get_origin(kind) is Literal for word in get_args(kind)]
        return value[0] if isinstance(value, tuple) and len(value) == 1 and value[0] in alone else value


def _list_options(package: ModuleType, function: str) -> dict[str, inspect.Parameter]:
    """Return the parameters of a function that can be given as text, typed for the command line."""
    taken, described = getattr(package, function), descriptions(package, function)
    hints, options = get_type_hints(taken), {}
    for name, one in inspect.signature(taken).parameters.items():
        kind = None if name in _LISTENERS or one.kind is one.VAR_KEYWORD else option_type(hints[name])
        if kind is None:
            continue
        text, default = _convert_help(described[name], described), one.default
        parameter = Parameter(help=text, negative="") if kind is bool else Parameter(help=text)
        if get_origin(kind) is tuple and get_args(kind)[-1] is ...:
            if default is not one.empty:
                default = () if default is None else (default,) if isinstance(default, str) else default
            shown = " ".join if default and default is not one.empty else False
            together = get_origin(get_args(kind)[0]) is not tuple
            parameter = Parameter(help=text, negative="", consume_multiple=together, show_default=shown)
        options[name] = one.replace(annotation=Annotated[kind, parameter], default=default)
    return options


def _convert_text(value: Any) -> Any:
    """Convert `PathText` to `str`, also in a tuple."""
    if isinstance(value, tuple):
        return tuple(map(_convert_text, value))
    return str(value) if isinstance(value, PathText) else value


def option_type(hint: Any) -> Any:
    """Return the type of an option for a parameter of some type, or None if it cannot be given as text."""
    kinds = list(union_members(hint))
    if Path in kinds:
        kinds = [PathText if kind is str else kind for kind in kinds]
    names = [kind for kind in _WORDS if kind in kinds] or [kind for kind in kinds if kind is Path]
    literals = [kind for kind in kinds if get_origin(kind) is Literal]
    for kind in kinds:
        element = option_type(get_args(kind)[0]) if get_origin(kind) in (Sequence, tuple) else None
        if element is None or (names and element not in names):
            continue
        if get_origin(kind) is tuple and get_args(kind)[-1] is not ...:
            return _make_optional(kind, kinds)
        if literals and get_origin(element) is Literal:
            element = Literal[(*(word for one in literals for word in get_args(one)), *get_args(element))]
        return tuple[element, ...]
    if plain := names or literals:
        return _make_optional(reduce(or_, plain), kinds)
    return tuple[str, ...] if any(get_origin(kind) is Mapping for kind in kinds) else None


def _make_optional(kind: Any, kinds: Iterable[Any]) -> Any:
    return kind | None if NoneType in kinds else kind


def parse_settings(option: str, texts: Sequence[str]) -> dict[str, Any]:
    """Return settings from texts NAME=VALUE; raises DescriptionError for another text."""
    from uwlts.errors import DescriptionError
    from uwlts.files.reading import parse_json

    settings: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise DescriptionError(f"`{option}` {text}: expected NAME=VALUE, such as half_window_px=32")
        try:
            settings[name] = parse_json(value)
        except ValueError:
            settings[name] = value
    return settings


# --- docstrings, read from the source: the list of commands does not import the functions' libraries


def descriptions(package: ModuleType, function: str) -> dict[str, str]:
    """Return the descriptions of parameters in a docstring; "As for `package.other`" refers to that function's."""
    found = {}
    sections = _split(docstring(package, function))
    parameters = dict(zip(sections[1::2], sections[2::2], strict=True)).get("Parameters", "")
    for listed, block in re.findall(r"^(\*?\w.*)\n((?:    .*\n?|\n(?=    ))+)", parameters, flags=re.MULTILINE):
        other = re.match(r"\s*As for `(?:(\w+)\.)?(\w+)`", block)
        elsewhere = descriptions(sys.modules.get(other[1], package), other[2]) if other else {}
        names = listed.split(" : ")[0].split(", ")
        found |= {name.lstrip("*"): elsewhere.get(name, " ".join(block.split())) for name in names}
    return found


def _convert_help(text: str, names: Collection[str]) -> str:
    """Return docstring text as a command's help: options instead of parameters, and no backticks."""
    return replace_by_options(text, names).replace("`", "")


def _split(text: str) -> list[str]:
    """Split a docstring into its prose, and then titles and texts of its sections in turn."""
    return re.split(r"^(\w+)\n-+\n", f"{text}\n", flags=re.MULTILINE)


@cache
def _read_modules(package: ModuleType) -> dict[str, str]:
    """Return the modules of the names in a package's stub."""
    stub = Path(f"{package.__file__}i").read_text(encoding="utf-8")
    return {
        alias.name: node.module
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


@cache
def docstring(package: ModuleType, function: str) -> str:
    """Return the docstring of a function in the package's stub, without importing the function."""
    place = Path(str(package.__file__)).parent.joinpath(*_read_modules(package)[function].split("."))
    source = (place / "__init__.py" if place.is_dir() else place.with_suffix(".py")).read_text(encoding="utf-8")
    found = re.search(rf'^def {function}\(.*?"""(.*?)"""', source, flags=re.MULTILINE | re.DOTALL)
    if found is None:
        raise ValueError(f"{function} has no docstring in {place}")
    return inspect.cleandoc(found[1])


# --- output of commands


def say(line: str) -> None:
    """Print a line at once, also to a pipe."""
    print(make_printable(line), flush=True)


def show(lines: Iterable[str]) -> None:
    """Print lines, with the command's options in place of parameters in backticks."""
    print(make_printable(replace_by_options("\n".join(lines))))
