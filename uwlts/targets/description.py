"""Descriptions of calibration targets: what is printed on the plate, in millimetres."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import cv2
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from uwlts.errors import DescriptionError
from uwlts.sensor import Description, Positive

Place = tuple[int, int]


class CircleTarget(Description):
    """A lattice of equal circles, three of them with a centred dot of the opposite brightness.

    Looking at the plate, X points right, Y down and Z away from the viewer into the plate; the origin is the centre of
    the circle at `origin`. Circles may be bright on dark or dark on bright.

    Attributes
    ----------
    spacing_x_mm, spacing_y_mm : distance between the centres of neighbours along X and along Y
    diameter_mm, marker_diameter_mm : of the circles and of the dots in three of them
    columns, rows : number of circles along X and along Y
    origin : place (column, row) of the first dotted circle, counted from the top left circle (0, 0)
    marker_x, marker_y : places of the dotted circles in +X and in +Y direction, counted from `origin`
    """

    kind: Literal["circles"] = "circles"
    spacing_x_mm: Positive = 9.375
    spacing_y_mm: Positive = 9.372
    diameter_mm: Positive
    marker_diameter_mm: Positive
    columns: Annotated[int, Field(ge=2)]
    rows: Annotated[int, Field(ge=2)]
    origin: Place
    marker_x: Place = (2, 0)
    marker_y: Place = (0, 2)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.diameter_mm >= min(self.spacing_x_mm, self.spacing_y_mm):
            raise ValueError(
                f"diameter_mm is {self.diameter_mm}; expected less than the spacing of {self.spacing_x_mm} x "
                f"{self.spacing_y_mm} mm, or the circles touch"
            )
        if self.marker_diameter_mm >= self.diameter_mm:
            raise ValueError(
                f"marker_diameter_mm is {self.marker_diameter_mm}; expected less than diameter_mm, {self.diameter_mm}"
            )
        for name, (di, dj) in (("origin", (0, 0)), ("marker_x", self.marker_x), ("marker_y", self.marker_y)):
            i, j = self.origin[0] + di, self.origin[1] + dj
            if not (0 <= i < self.columns and 0 <= j < self.rows):
                raise ValueError(
                    f"{name} is at ({i}, {j}); expected a place of the {self.columns} x {self.rows} lattice"
                )
        if self.marker_x[0] * self.marker_y[1] == self.marker_x[1] * self.marker_y[0]:
            raise ValueError(
                f"marker_x {self.marker_x} and marker_y {self.marker_y} lie on one line with the origin; "
                "expected two directions, or the marks do not tell how the plate is turned"
            )
        return self


class ChessboardTarget(Description):
    """A chessboard, known by its inner corners.

    Looking at the board, X points right, Y down and Z into the board; the origin is the top left inner corner. Where
    one of `columns` and `rows` is odd and the other even, the squares tell a board from the same board turned by half
    a turn: the square above and to the left of the origin is dark. Otherwise the turn with X pointing most to the
    right in the image is taken.

    Attributes
    ----------
    columns, rows : number of inner corners along X and along Y
    square_mm : side of a square
    """

    kind: Literal["chessboard"] = "chessboard"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_mm: Positive


class CharucoTarget(Description):
    """A chessboard with ArUco markers in its white squares.

    Looking at the board, X points right, Y down and Z into the board; the origin is the top left corner of the board
    (OpenCV's frame), so the first inner corner is at (square_mm, square_mm).

    Attributes
    ----------
    columns, rows : number of squares along X and along Y
    square_mm, marker_mm : sides of a square and of a marker
    dictionary : name of the predefined marker dictionary, such as DICT_4X4_100
    legacy : whether the board has the pattern of OpenCV before 4.6 (differs where `rows` is even)
    """

    kind: Literal["charuco"] = "charuco"
    columns: Annotated[int, Field(ge=3)]
    rows: Annotated[int, Field(ge=3)]
    square_mm: Positive
    marker_mm: Positive
    dictionary: str = "DICT_4X4_100"
    legacy: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm is {self.marker_mm}; expected less than square_mm, {self.square_mm}")
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary not in known:
            raise ValueError(f"dictionary is {self.dictionary!r}; expected one of {', '.join(known)}")
        available = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = self.columns * self.rows // 2
        if needed > available:
            raise ValueError(f"the board needs {needed} markers; {self.dictionary} has only {available}")
        return self


Target = CircleTarget | ChessboardTarget | CharucoTarget

_ADAPTER = TypeAdapter(Annotated[Target, Field(discriminator="kind")])


def parse_target(mapping: Mapping[str, Any]) -> Target:
    """Make a target description from keys and values, as read from a file.

    Raises
    ------
    DescriptionError
        `kind` is missing or unknown, a key is unknown or missing, or a value is impossible.
    """
    if not isinstance(mapping, Mapping):
        raise DescriptionError(f"the target is a {type(mapping).__name__}; expected a table of keys and values")
    try:
        return _ADAPTER.validate_python(dict(mapping))
    except ValidationError as error:
        lines = [_explained(problem) for problem in error.errors()]
        raise DescriptionError("the target cannot be read: " + "; ".join(lines)) from error


def _explained(problem):
    # The first part of the location is the kind, which the reader knows.
    name = ".".join(str(part) for part in problem["loc"][1:])
    text = problem["msg"].removeprefix("Value error, ")
    match problem["type"]:
        case "extra_forbidden":
            return f"{name} is not a key of this kind of target"
        case "missing":
            return f"{name} is missing"
        case "union_tag_invalid" | "union_tag_not_found":
            return f"{text} (kind is one of 'circles', 'chessboard', 'charuco')"
        case _:
            return f"{name}: {text}, found {problem['input']!r}" if name else text
