"""What models found, beside the truth and the prior: one strip of pictures a keyframe."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from presight_perception.dataset import PriorBatch
from presight_perception.experiment.keyframes import CAMERAS, Keyframe
from presight_perception.experiment.tasks import MapTask, OccupancyTask, Task
from presight_perception.map_truth import MAP_CLASSES, RasterSettings, rasterise
from presight_perception.metrics import ScoredLines
from presight_perception.occupancy_truth import FREE, OccupancyTruth
from presight_perception.voxelise import VoxelGrid

Picture = NDArray[np.uint8]  # (H, W, 3) BGR

HEIGHT_PX = 240  # of every picture
CLASS_COLOURS = ((230, 150, 40), (40, 190, 230), (60, 60, 220))  # BGR of crossings, dividers, boundaries
LEAST_SCORE = 0.4  # of a line that is shown
BACKGROUND = 245
CAPTION_PX = 20


@dataclass(frozen=True)
class Panel:
    """One picture of a strip."""

    caption: str
    picture: Picture


def write_strip(file: Path, panels: Sequence[Panel]) -> None:
    """Pictures side by side, each under its caption."""
    tall = [_captioned(panel) for panel in panels]
    cv2.imwrite(str(file), np.concatenate(tall, 1))


def front_camera(keyframe: Keyframe) -> Picture:
    """The image of the front camera."""
    return np.asarray(cv2.imread(str(keyframe.images[CAMERAS.index("CAM_FRONT")])), np.uint8)


def true_picture(task: Task, model: Any, keyframe: Keyframe) -> Picture:
    """What there is."""
    if isinstance(task, MapTask):
        return _masks_picture(rasterise(task.lines(keyframe), task.range, _raster(task)).astype(np.bool_))
    assert isinstance(task, OccupancyTask)
    return _voxels_picture(model.in_range(task.occupancy(keyframe)))


def found_picture(task: Task, model: Any, found: Any, keyframe: Keyframe) -> Picture:
    """What a model found, of `decode`."""
    if isinstance(found, ScoredLines):
        assert isinstance(task, MapTask)
        sure = [k for k in range(len(found.lines)) if found.scores[k] >= LEAST_SCORE]
        lines = {name: [found.lines[k] for k in sure if MAP_CLASSES[found.labels[k]] == name] for name in MAP_CLASSES}
        return _masks_picture(rasterise(lines, task.range, _raster(task)).astype(np.bool_))
    if isinstance(task, OccupancyTask):
        truth = model.in_range(task.occupancy(keyframe))
        return _voxels_picture(OccupancyTruth(found, truth.mask_camera, truth.mask_lidar))
    return _masks_picture(found)


def prior_picture(prior: PriorBatch, grid: VoxelGrid) -> Picture:
    """The highest voxels from above, by the first three feature channels, or by height where there are none."""
    picture = np.full((*grid.shape[1::-1], 3), BACKGROUND, np.uint8)
    mine = prior.coordinates[:, 0] == 0
    x, y, z = prior.coordinates[mine, 1:].numpy().T
    voxels = prior.voxels[mine].numpy()
    low = z < grid.shape[2] // 2  # crowns of trees would hide the street
    x, y, z, voxels = x[low], y[low], z[low], voxels[low]
    colours = voxels[:, 3:6] if voxels.shape[1] > 4 else np.repeat(voxels[:, 2:3], 3, 1)
    order = np.argsort(z, kind="stable")
    picture[y[order], x[order]] = (np.clip(colours[order], 0, 1) * 255).astype(np.uint8)
    return picture[::-1]


def _raster(task: MapTask) -> RasterSettings:
    return RasterSettings(round(8 * task.range.width_m), round(8 * task.range.length_m), thickness_px=3)


def _masks_picture(masks: NDArray[np.bool_]) -> Picture:
    """Masks (classes, H, W), left of the vehicle up."""
    picture = np.full((*masks.shape[1:], 3), BACKGROUND, np.uint8)
    for mask, colour in zip(masks, CLASS_COLOURS, strict=True):
        picture[mask] = colour
    return picture[::-1]


def _voxels_picture(truth: OccupancyTruth) -> Picture:
    """The highest occupied voxel of every column that a camera saw, from above; left of the vehicle up."""
    shown = np.where(truth.mask_camera & (truth.semantics < FREE), truth.semantics, FREE)
    top = shown.shape[2] - 1 - (shown[:, :, ::-1] != FREE).argmax(2)
    classes = np.take_along_axis(shown, top[:, :, None], 2)[:, :, 0]  # (X, Y)
    hues = (np.arange(FREE + 1) * 180 / (FREE + 1)).astype(np.uint8)
    hsv = np.stack([hues, np.full_like(hues, 170), np.full_like(hues, 230)], -1)[None]
    palette = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0]
    palette[FREE] = BACKGROUND
    return palette[classes].transpose(1, 0, 2)[::-1].astype(np.uint8)


def _captioned(panel: Panel) -> Picture:
    height, width = panel.picture.shape[:2]
    size = round(width * HEIGHT_PX / height), HEIGHT_PX
    picture = cv2.resize(panel.picture, size, interpolation=cv2.INTER_AREA if height > HEIGHT_PX else cv2.INTER_NEAREST)
    caption = np.full((CAPTION_PX, size[0], 3), 255, np.uint8)
    cv2.putText(caption, panel.caption, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    framed = np.concatenate([caption, picture]).astype(np.uint8)
    return np.pad(framed, ((0, 4), (0, 4), (0, 0)), constant_values=255)
