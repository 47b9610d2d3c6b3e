"""How this package compiles its kernels."""

import numba

# nogil: views render side by side in threads, each kernel on its own arrays.
# fastmath: reassociation changes the last bits only, and the same build gives the same bytes.
jit = numba.njit(cache=True, nogil=True, fastmath=True)
