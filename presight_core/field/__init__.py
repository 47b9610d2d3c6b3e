"""The neural field of a tile: hash grids, samplers, rendering, losses.

Inside this package coordinates are of the `field` frame: metres like `world`, but relative to the
field's origin, so that float32 is fine enough.
"""

import os

# Idle OpenMP threads sleep instead of spinning: tiles share a machine, and spinning starves the neighbours.
# Read by the runtime once, when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
