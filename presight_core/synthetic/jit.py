"""How this package compiles its kernels."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

# nogil: views render side by side in threads, each kernel on its own arrays.
# fastmath: reassociation changes the last bits only, and the same build gives the same bytes.
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True}

# What Python calls: kept on disk. Nobody calls from C, and a wrapper for that takes a tenth of the time to compile.
_KEPT: dict[str, Any] = {"cache": True, "no_cfunc_wrapper": True, **_OPTIONS}
kernel = numba.njit(**_KEPT)

# A kernel that allocates nothing: its callers own all arrays, so it need not count references to them, which would
# take three quarters of its time, pixel by pixel.
_UNCOUNTED: dict[str, Any] = {"_nrt": False, **_KEPT}
shader = numba.njit(**_UNCOUNTED)

# What kernels call: becomes part of them, and needs no wrapper for Python either.
_BARE: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_OPTIONS}
inner = numba.njit(**_BARE)

# What takes whole scenes: pasted into its caller, since passing three dozen arrays costs more than most calls do.
spliced = numba.njit(inline="always", **_OPTIONS)


def typed(signature: str, python: bool = False) -> Callable:
    """Like `inner`, compiled once for this signature; otherwise every literal argument makes another copy.

    `python`: Python may call it too; without its wrapper that would be a crash.
    """
    options: dict[str, Any] = _BARE | {"cache": True, "no_cpython_wrapper": not python}
    return numba.njit(signature, **options)


def _drop_stale_kernels() -> None:
    """Delete kernels older than any source they could come from: numba looks at the outermost function's file only."""
    folder = Path(__file__).parent
    sources = [folder / "jit.py", folder / "materials.py"]  # materials: kernels hold their numbers
    sources += [
        source for source in folder.glob("*.py") if "synthetic.jit import" in source.read_text(encoding="utf-8")
    ]
    newest = max(source.stat().st_mtime for source in sources)
    for index in (folder / "__pycache__").glob("*.nbi"):
        with contextlib.suppress(OSError):  # gone already, or an installation we may not write to
            if index.stat().st_mtime < newest:
                index.unlink()


_drop_stale_kernels()
