"""Reading one block of G-code as Grbl 1.1 does, for one axis: its words, or the number of its error."""

import re
from dataclasses import dataclass

_WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))")
# Command to its modal group; the axis commands of group 0 exclude each other as well.
_GROUPS = {
    "G4": "once", "G53": "once", "G92": "once", "G92.1": "once", "G0": "motion", "G1": "motion", "G80": "motion",
    "G17": "plane", "G90": "distance", "G91": "distance", "G94": "feed", "G20": "units", "G21": "units",
    "G40": "cutter",
    "G49": "length", "G54": "system", "G61": "control", "M0": "stop", "M2": "stop", "M30": "stop", "M3": "spindle",
    "M4": "spindle", "M5": "spindle", "M7": "coolant", "M8": "coolant", "M9": "coolant",
}  # fmt: skip
_VALUES = "XFSPNT"


class GrblError(Exception):
    """A line that Grbl answers with ``error:code``."""

    def __init__(self, code: int):
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True)
class Block:
    """The commands of a line by modal group, its values by letter, and whether G53 is among them."""

    commands: dict[str, str]
    values: dict[str, float]
    machine_coordinates: bool


def parse_block(line: str) -> Block:
    """Words of a line without spaces and comments, in capitals; GrblError with Grbl's number."""
    commands: dict[str, str] = {}
    values: dict[str, float] = {}
    machine_coordinates, position = False, 0
    while position < len(line):
        found = _WORD.match(line, position)
        if not found:
            raise GrblError(2 if line[position].isalpha() else 1)
        position, letter, number = found.end(), found[1], float(found[2])
        if letter in "GM":
            command = f"{letter}{number:g}"
            if command not in _GROUPS:
                raise GrblError(20)
            if command == "G53":
                machine_coordinates = True
            elif commands.setdefault(_GROUPS[command], command) != command:
                raise GrblError(21)
        elif letter not in _VALUES:
            raise GrblError(20)
        elif letter in values:
            raise GrblError(25)
        elif letter in "FSPNT" and number < 0:
            raise GrblError(4)
        else:
            values[letter] = number
    _refuse_incomplete(commands, values, machine_coordinates)
    return Block(commands, values, machine_coordinates)


def _refuse_incomplete(commands: dict[str, str], values: dict[str, float], machine_coordinates: bool) -> None:
    once, motion = commands.get("once"), commands.get("motion")
    if once == "G4" and "P" not in values:
        raise GrblError(28)
    if "P" in values and once != "G4":
        raise GrblError(36)
    if once == "G92" and "X" not in values:
        raise GrblError(26)
    if once == "G92" and motion:
        raise GrblError(24)
    if machine_coordinates and motion == "G80":
        raise GrblError(30)
    if once == "G4" and "X" in values:
        raise GrblError(31)
