"""Loads one libLLVM and prints its version as JSON; run by `twin.backend.llvm` as a script of its own.

A library of the wrong kind can end the process that loads it, and two libLLVM in one process may disturb each other,
so this happens in a child process. Needs nothing but the standard library.

Prints `{"version": [major, minor, patch] or null, "companions": [path, ...]}`, or `{"fault": text}`. The version is
null when the library has no LLVMGetVersion. Companions are the libraries from the same folder that had to be loaded
first, in loading order, because the system has none of that name.
"""

import ctypes
import json
import re
import sys
from pathlib import Path


def load_with_companions(library: str, companions: list[str]) -> ctypes.CDLL:
    """Load a library; what the loader misses is taken from the library's own folder, needed ones first."""
    asked: set[str] = set()
    while True:
        try:
            return ctypes.CDLL(library)
        except OSError as error:
            missing = re.match(r"([^\s/]+): cannot open shared object file", str(error))
            # A name that is asked for again was loaded under another name: the loader will never accept it.
            if missing is None or missing[1] in asked:
                raise
            asked.add(missing[1])
            folder = Path(library).parent
            beside = [folder / missing[1], *sorted(folder.glob(f"{missing[1]}.*"))]
            found = next((str(path) for path in beside if path.is_file()), None)
            if found is None:
                raise
            load_with_companions(found, companions)
            companions.append(found)


def describe(library: str) -> dict[str, object]:
    """Version and companions of the library, or the fault that keeps it from being used."""
    companions: list[str] = []
    try:
        handle = load_with_companions(library, companions)
    except OSError as error:
        return {"fault": f"it does not load: {error}"}
    if not hasattr(handle, "LLVMContextCreate"):
        return {"fault": "it is no libLLVM: it lacks the function LLVMContextCreate"}
    if not hasattr(handle, "LLVMGetVersion"):
        return {"version": None, "companions": companions}
    numbers = [ctypes.c_uint() for _ in range(3)]
    handle.LLVMGetVersion(*map(ctypes.byref, numbers))
    return {"version": [number.value for number in numbers], "companions": companions}


if __name__ == "__main__":
    print(json.dumps(describe(sys.argv[1])))
