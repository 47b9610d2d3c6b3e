"""Process-wide settings that make training on a CPU fast."""

import ctypes
import platform

import numba
import torch
from numba.core import config

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # numbers of glibc's malloc.h
KEEP_BELOW_BYTES = 1 << 30


def use_threads(count: int) -> None:
    """Give torch and numba the same number of threads, as far as numba has been allowed so many."""
    torch.set_num_threads(count)
    numba.set_num_threads(min(count, config.NUMBA_NUM_THREADS))  # pyright: ignore[reportAttributeAccessIssue] - set at run time


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks up to 1 GiB for the next step instead of giving them back to the system.

    Otherwise every step unmaps and refaults its activations: 1.25 to 1.4 times slower. The process keeps
    its peak. Does nothing where the C library is another one.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    library = ctypes.CDLL(None)
    library.mallopt(M_MMAP_THRESHOLD, KEEP_BELOW_BYTES)
    library.mallopt(M_TRIM_THRESHOLD, 2 * KEEP_BELOW_BYTES - 1)


def has_fast_bfloat16(device: str) -> bool:
    """Whether the device multiplies bfloat16 matrices faster than float32.

    A processor does with AVX-512's bfloat16 instructions or with tile registers, AMX (docs/benchmarks/field.md).
    """
    if device.startswith("cuda"):
        return torch.cuda.is_bf16_supported()
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
