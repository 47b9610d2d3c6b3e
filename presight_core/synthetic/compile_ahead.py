"""The shader, compiled by a process of its own while the city is built: it is most of what a first run compiles."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from presight_core.cameras import Camera
from presight_core.synthetic.actors import actor_mesh
from presight_core.synthetic.lamps import head_light_beams, lamp_grid
from presight_core.synthetic.lighting import sample_lighting
from presight_core.synthetic.renderer import pinhole_view
from presight_core.synthetic.shade import Scene, shade_view
from presight_core.synthetic.shadow import ZENITH, cast_shadows, shadow_map


class ShaderAhead:
    """`shade_view`, whose first call waits until it is compiled. Without a second process it compiles by itself."""

    def __init__(self) -> None:
        compiled = any(Path(str(shade_view.stats.cache_path)).glob("shade.shade_view-*.nbi"))
        self._compiling = None if compiled else subprocess.Popen([sys.executable, "-m", __name__])

    def __call__(self, *arguments: Any) -> None:
        """See `shade_view`."""
        if self._compiling:
            self._compiling.wait()
        shade_view(*arguments)


def compile_shader() -> None:
    """Compile `shade_view`, which shades an empty view of nothing, and keep it on disk."""
    nothing, lighting = actor_mesh(()), sample_lighting("night", np.random.default_rng(0))
    shadows = cast_shadows(nothing, lighting, np.zeros(3), 1.0)
    shadow = shadow_map(nothing, ZENITH, np.zeros(3), 1.0, 1.0)
    beams = head_light_beams((), None, np.zeros(2))
    scene = Scene(nothing, nothing, lighting, shadows, shadow, shadow, lamp_grid(np.zeros((0, 3))), beams)
    view = pinhole_view(Camera(np.eye(3), np.eye(4), width_px=1, height_px=1))
    samples = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.int32)
    shade_view(scene, view, True, *samples, np.zeros((0, 0, 3), np.float32))


if __name__ == "__main__":
    compile_shader()
