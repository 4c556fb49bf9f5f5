"""Chooses Mitsuba's variant once, after making sure that its LLVM back end cannot abort the process.

Call `use_variant` before importing any module of the twin that renders: Mitsuba and Dr.Jit look for libLLVM when they
are imported.
"""

from twin.llvm import prepare_llvm
from uwlts.errors import SetupError

CPU, GPU = "llvm_ad_mono", "cuda_ad_mono"


def use_variant(name: str = CPU) -> str:
    """Select a monochromatic variant, ``llvm_ad_mono`` or ``cuda_ad_mono``; returns its name.

    Raises
    ------
    SetupError
        libLLVM is missing or too old, there is no CUDA device, or the variant is not one of the two.
    """
    if name not in (CPU, GPU):
        raise SetupError(f"variant '{name}' is not supported; use {CPU} or {GPU}")
    if name == CPU:
        prepare_llvm()
    import mitsuba as mi

    try:
        mi.set_variant(name)
        mi.Float(0.0)
    except (ImportError, RuntimeError) as error:
        raise SetupError(f"Mitsuba cannot use {name} on this machine: {error}") from error
    return name
