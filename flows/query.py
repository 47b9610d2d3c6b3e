"""`presight query`: the prior around a pose, as figures and as a picture."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flows.console import print_json
from presight_core import frames
from presight_core.errors import SettingsError
from presight_core.priors.reader import PriorReader
from storage.workspace import Workspace

HEIGHT_M = (-3.0, 5.0)  # the range of the paper's perception models


@dataclass(frozen=True)
class Place:
    """A rectangle around a pose of the world."""

    x_m: float
    y_m: float
    yaw_deg: float  # counter-clockwise from east
    length_m: float  # along the heading
    width_m: float

    @staticmethod
    def parse(at: str, extent: str) -> "Place":
        """The place of `--at X,Y,YAW --range LENGTHxWIDTH`. Raises SettingsError for anything else."""
        try:
            x, y, yaw = (float(part) for part in at.split(","))
        except ValueError:
            raise SettingsError(f"--at {at}: write three numbers X,Y,YAW, for example --at 412.5,1180.0,90") from None
        try:
            length, width = (float(part) for part in extent.lower().split("x"))
        except ValueError:
            raise SettingsError(f"--range {extent}: write LENGTHxWIDTH in metres, for example 100x50") from None
        return Place(x, y, yaw, length, width)


def show_window(folder: Path, city: str, generation: int | None, place: Place, png: Path | None, as_json: bool) -> None:
    """Print what the prior holds around a place, and draw it if a file is given."""
    reader = PriorReader.open(Workspace.open(folder).store_location, city, generation)
    world_from_ego = frames.planar_transform(place.x_m, place.y_m, np.deg2rad(place.yaw_deg))
    x_m, y_m = (-place.length_m / 2, place.length_m / 2), (-place.width_m / 2, place.width_m / 2)
    window = reader.window(world_from_ego, x_m, y_m, HEIGHT_M)
    answer = {
        "city": city,
        "generation": reader.generation.number,
        "space_id": reader.space_id,
        "channels": reader.channel_count,
        "tiles": list(window.tiles),
        "voxels": len(window),
        "hits": int(window.hits.sum()),
        "observed_share": round(window.coverage, 4),
    }
    if png is not None:
        from presight_core.maps import prior_picture
        from presight_core.pictures import save_png

        save_png(png, prior_picture(window, x_m, y_m, reader.lattice.voxel_m))
        answer["png"] = str(png)
    if as_json:
        print_json(answer)
        return
    for name, value in answer.items():
        print(f"{name:15} {', '.join(value) if isinstance(value, list) else value}")
