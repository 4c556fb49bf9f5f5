"""Check of the arguments of public functions, in one place for all of them: their types, and no input as an output.

`attach_public` makes the names of a package's stub available when they are first used; functions among them check their
arguments. Modules inside the packages import the functions themselves, which do not.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from reprlib import Repr
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import lazy_loader

from uwlts.errors import ArgumentError, OutputError

P = ParamSpec("P")
R = TypeVar("R")

_SHORT = Repr()  # short texts of values, for messages
_SHORT.maxstring = _SHORT.maxother = 60


OUTPUTS = frozenset({"out", "coloured", "aligned", "page", "poses_out", "mount_out"})
"""Names of command parameters that are outputs; all other parameters that name a file are inputs."""
_WRITTEN = OUTPUTS | {"path"}
"""Names of function parameters that may be outputs; a function that reads its ``path`` writes nothing else."""
_inputs: ContextVar[tuple[str, ...]] = ContextVar("inputs", default=())


_MISFIT = object()
"""Result of the conversion of a value that does not have a type."""


@contextmanager
def protect_inputs(arguments: Mapping[str, object]) -> Iterator[None]:
    """Protect the files that arguments name as inputs: in this context `refuse_input` refuses them as outputs."""
    named = [name for key in arguments.keys() - _WRITTEN for name in _list_file_names(arguments[key])]
    token = _inputs.set((*_inputs.get(), *filter(os.path.isfile, named)))
    try:
        for key in OUTPUTS.intersection(arguments):
            for name in _list_file_names(arguments[key]):
                refuse_input(name)
        yield
    finally:
        _inputs.reset(token)


def refuse_input(target: str | os.PathLike[str]) -> None:
    """Raise OutputError if a file to be written is an input (`protect_inputs`), under whatever name."""
    for path in _inputs.get():
        if os.path.isfile(target) and os.path.isfile(path) and os.path.samefile(target, path):
            also = "" if os.path.abspath(target) == os.path.abspath(path) else f" (it is the same file as {path})"
            raise OutputError(f"cannot write {target}: it is an input of this command{also}; give another name")


def _list_file_names(value: object) -> Iterable[str]:
    """Iterate over names of files that an argument may contain, also after a prefix, as in replay:PATH."""
    if isinstance(value, str | os.PathLike):
        name = os.fspath(value)
        yield from (name, name.partition(":")[2])
    elif isinstance(value, Sequence) and not isinstance(value, bytes):
        for each in value:
            yield from _list_file_names(each)


def attach_public(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package with a stub file beside ``file``."""
    find, list_names, names = lazy_loader.attach_stub(package, file)

    def find_checked(name: str) -> Any:
        found = find(name)
        if inspect.isfunction(found):
            found = check_arguments(found, keep_inputs=True)
            # Pickled by its public name, under which it is found again.
            found.__module__, found.__qualname__ = package, name
            # The loader keeps what it has found, without the check.
            setattr(sys.modules[package], name, found)
        return found

    return find_checked, list_names, names


def check_arguments(function: Callable[P, R], *, keep_inputs: bool = False) -> Callable[P, R]:
    """Make a function raise ArgumentError for arguments that do not have the types of its parameters.

    Lists of numbers become arrays where the function takes an array. With ``keep_inputs`` the function cannot replace
    its inputs (`protect_inputs`).
    """

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        signature = inspect.signature(function)
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:
            return function(*args, **kwargs)  # Python's message has the function's name
        hints = _read_hints(function)
        for name, value in bound.arguments.items():
            kind = signature.parameters[name].kind
            if name not in hints or kind is inspect.Parameter.VAR_KEYWORD:
                continue
            several = kind is inspect.Parameter.VAR_POSITIONAL
            given = value if several else (value,)
            values = [_convert(each, hints[name]) for each in given]
            for each, converted in zip(given, values, strict=True):
                if converted is _MISFIT:
                    raise ArgumentError(_describe_misfit(name, each, hints[name]))
            bound.arguments[name] = tuple(values) if several else values[0]
        with protect_inputs(bound.arguments) if keep_inputs else nullcontext():
            return function(*bound.args, **bound.kwargs)

    return checked


@cache
def _read_hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of a function's parameters; that of its result may be unknown when it runs."""
    annotations = {name: hint for name, hint in inspect.get_annotations(function).items() if name != "return"}
    return get_type_hints(
        SimpleNamespace(__annotations__=annotations),
        globalns=inspect.unwrap(function).__globals__,
        include_extras=False,
    )


def _describe_misfit(name: str, value: Any, hint: Any) -> str:
    shown = _SHORT.repr(value)
    single = any(_is_list(kind) and _convert([value], kind) is not _MISFIT for kind in union_members(hint))
    advice = f"; give a single one as [{shown}]" if single else ""
    return f"`{name}` is {shown} ({type(value).__name__}), expected {_describe(hint)}{advice}"


def union_members(hint: Any) -> Iterator[Any]:
    """Iterate over the types of a union, or the type itself, without annotations."""
    if get_origin(hint) is Annotated:
        yield from union_members(get_args(hint)[0])
    elif get_origin(hint) in (Union, UnionType):
        for each in get_args(hint):
            yield from union_members(each)
    else:
        yield hint


def _is_array(kind: Any) -> bool:
    origin = get_origin(kind) or kind
    return (origin.__module__, origin.__name__) == ("numpy", "ndarray")


def _is_list(kind: Any) -> bool:
    return get_origin(kind) in (Sequence, list) or (get_origin(kind) is tuple and get_args(kind)[-1] is ...)


def _is_path(kind: Any) -> bool:
    origin = get_origin(kind) or kind
    return origin is os.PathLike or (isinstance(origin, type) and issubclass(origin, Path))


def _convert(value: Any, hint: Any) -> Any:
    """Return a value in one of the types of a union, or `_MISFIT`."""
    for kind in union_members(hint):
        origin, parts = get_origin(kind) or kind, get_args(kind)
        converted, fits = value, True
        if origin is Literal:
            fits = any(value == word for word in parts if _is_instance(value, type(word)))
        elif origin in (Sequence, list, tuple):
            converted = _convert_entries(value, origin, parts)
        elif _is_array(kind):
            converted = _convert_to_array(value)
        elif origin in (Mapping, dict):
            fits = isinstance(value, Mapping) and all(_convert(one, parts[1]) is not _MISFIT for one in value.values())
        elif origin not in (Any, object):
            fits = _is_instance(value, origin)
        if fits and converted is not _MISFIT:
            return converted
    return _MISFIT


def _is_instance(value: Any, kind: Any) -> bool:
    """Return whether a value is of a type; a bool is not a number here, and NumPy's scalars are Python's."""
    is_bool = type(value).__name__ in ("bool", "bool_")
    if kind is bool:
        return is_bool
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not is_bool
    if kind is Callable or getattr(kind, "_is_protocol", False):
        return callable(value)
    return isinstance(value, os.PathLike if kind is Path else kind)


def _convert_entries(value: Any, origin: Any, parts: tuple[Any, ...]) -> Any:
    if isinstance(value, str | bytes) or not (isinstance(value, Sequence) or _is_array(type(value))):
        return _MISFIT
    if origin is not tuple or parts[-1] is ...:
        parts = parts[:1] * len(value)
    entries = list(value)
    converted = list(map(_convert, entries, parts))
    if len(entries) != len(parts) or any(each is _MISFIT for each in converted):
        return _MISFIT
    if origin is tuple:
        return tuple(converted)
    return value if all(one is other for one, other in zip(entries, converted, strict=True)) else converted


def _convert_to_array(value: Any) -> Any:
    """Return an array, or numbers in lists or tables as an array."""
    import numpy as np

    if isinstance(value, str | bytes | os.PathLike | Mapping | NoneType):
        return _MISFIT
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return _MISFIT
    return array if array.ndim and array.dtype.kind in "biuf" else _MISFIT


def _describe(hint: Any) -> str:
    """Return the expected types as text; None, which the signature shows as default, is left out."""
    kinds = [kind for kind in union_members(hint) if kind is not NoneType]
    named = any(map(_is_path, kinds))
    names = list(dict.fromkeys(word for kind in kinds for word in _name_kinds(kind, beside_path=named)))
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


def _name_kinds(kind: Any, *, beside_path: bool) -> list[str]:
    origin, parts = get_origin(kind) or kind, get_args(kind)
    plain = {str: "text", int: "a whole number", float: "a number", bool: "True or False"}
    if _is_path(kind) or (kind is str and beside_path):
        return ["a path"]
    if origin is Literal:
        return [repr(word) for word in parts]
    if origin in plain:
        return [plain[origin]]
    if _is_array(kind):
        return ["an array of numbers"]
    if _is_list(kind):
        return [f"a list (entries: {_describe(parts[0])})"]
    if origin is tuple:
        return [f"{len(parts)} values ({', '.join(dict.fromkeys(map(_describe, parts)))})"]
    if origin in (Mapping, dict):
        return ["a dictionary" if parts[1] is Any else f"a dictionary (values: {_describe(parts[1])})"]
    if origin is Callable or getattr(origin, "_is_protocol", False):
        return ["a function"]
    return [f"{'an' if origin.__name__[0] in 'AEIOU' else 'a'} {origin.__name__}"]
