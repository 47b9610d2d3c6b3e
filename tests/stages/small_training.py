"""A tile that trains in a moment: its settings, frames and images."""

import numpy as np

from presight_core import classes
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import FrameTable
from presight_core.frames import planar_transform
from presight_core.pixels import FramePixels, PixelSource
from presight_core.tiles import SubField
from stages.training import TileTraining

TINY = (
    "training.steps=12", "training.batch_rays=64", "training.checkpoint_every=6", "training.holdout_every=4",
    "field.hidden_width=8", "field.proposal_width=8", "field.grid.log2_rows=8", "field.grid.max_resolution=64",
    "field.grid.levels=3", "sampling.proposal_samples=[12, 8]", "sampling.field_samples=8",
    "training.stereo.weight=0.0",
)  # fmt: skip


def tiny_settings(*overrides: str) -> CitySettings:
    return load_city_settings(None, ["preset=demo", *TINY, *overrides])


EGO_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
SIZE = (24, 16)


class Gradient(PixelSource):
    """Images whose upper half is sky, whose lower half is road, and whose left column is a car."""

    def load(self, row: int) -> FramePixels:
        width, height = SIZE
        rgb = np.zeros((height, width, 3), np.uint8)
        rgb[: height // 2] = (90, 140, 230)
        rgb[height // 2 :] = 70 + row
        labels = np.full((height // 2, width // 2), 0, np.uint8)
        labels[: height // 4] = classes.SKY
        labels[:, 0] = classes.CITYSCAPES.index("car")
        features = np.zeros((height // 4, width // 4, 3), np.uint8)
        features[height // 8 :] = 255
        return FramePixels(rgb, labels, features)


def street(count: int = 8, drives: int = 1) -> FrameTable:
    poses = np.stack([planar_transform(x, 0, 0) @ EGO_FROM_CAMERA for x in np.linspace(0, 10, count)])
    return FrameTable(
        drive_id=np.array([f"drive{i * drives // count}" for i in range(count)]),
        camera=np.full(count, "CAM_FRONT"),
        timestamp_us=np.arange(count) * 500_000,
        path=np.array([f"{i}.jpg" for i in range(count)]),
        file_bytes=np.ones(count, np.int64),
        width_px=np.full(count, 48, np.int32),  # twice the working resolution
        height_px=np.full(count, 32, np.int32),
        intrinsics=np.tile(np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), (count, 1, 1)),
        world_from_camera=poses,
        is_keyframe=np.arange(count) % 2 == 0,
    )


def tiny_job(*overrides: str, frames: FrameTable | None = None) -> TileTraining:
    halves = (
        SubField((2.5, 0, 1.5), (-15, -15, -4), (20, 15, 16)),
        SubField((7.5, 0, 1.5), (-10, -15, -4), (25, 15, 16)),
    )
    return TileTraining("t000", street() if frames is None else frames, halves, tiny_settings(*overrides), 3)
