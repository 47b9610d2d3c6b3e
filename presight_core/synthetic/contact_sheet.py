"""A contact sheet: one look at a synthetic data set, drawn from its files."""

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from presight_core.classes import CITYSCAPES, UNKNOWN
from presight_core.images import read_rgb
from presight_core.maps import MapView, birds_eye, height_colours
from presight_core.pictures import depth_image, label_image, save_png, stack_rows, title_strip
from presight_core.synthetic import nuscenes
from presight_core.synthetic.map_picture import PIXELS_A_METRE
from presight_core.synthetic.occupancy import FREE
from presight_core.synthetic.presets import DriveOrder, SynthPreset

Rgb = NDArray[np.uint8]

AROUND = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT")
PAGE_PX = 1460  # width
ROW_PX = 135  # height of a row: six cameras fit a page
PLAN_PX = 290  # height of the bird's-eye pictures
REACH_M = 40.0  # of the bird's-eye pictures
ROLE_COLOURS = {"train": (40, 110, 220), "prior": (30, 150, 60), "test": (220, 60, 40)}

# Occ3D's classes in the colours of the Cityscapes class that is most like them; free space is unknown, and black.
_LABELS = np.array(
    [UNKNOWN] + [CITYSCAPES.index(name) for name in (
        "fence", "bicycle", "bus", "car", "truck", "motorcycle", "person", "traffic sign", "train", "truck", "road",
        "wall", "sidewalk", "terrain", "building", "vegetation",
    )] + [UNKNOWN], np.uint8,
)  # fmt: skip


def draw_contact_sheet(root: Path, preset: SynthPreset) -> Path:
    """Draw a drive of each town and light at half time, the ground truth of the first, and the maps."""
    rows: list[Rgb] = []
    shown: set[tuple[str, str]] = set()
    for order in preset.drives:
        if (order.location, order.light) not in shown:
            shown.add((order.location, order.light))
            moment = _Moment(root, preset, order)  # once: it keeps the drive's rows
            images = [moment.image(channel) for channel in AROUND]
            rows.extend(_titled(f"{order.scene}, {order.location}, {order.light}", images, ROW_PX))
    first = _Moment(root, preset, preset.drives[0])
    rows.extend(_titled(f"{first.order.scene}, ground truth: depth, classes, objects", first.truth(), ROW_PX))
    plans = [*first.from_above(), *(_map(root, preset, location) for location in preset.towns)]
    what = [name for name, is_there in (("lidar", preset.lidar), ("occupancy", preset.occupancy)) if is_there]
    title = ", ".join([*what, "the cities and their drives (train blue, prior green, test red)"])
    rows.extend(_titled(f"from above: {title}", plans, PLAN_PX))
    file = root / "contact_sheet.png"
    save_png(file, stack_rows([[row] for row in rows]))
    return file


class _Moment:
    """The keyframe at half time of a drive, read from its files."""

    def __init__(self, root: Path, preset: SynthPreset, order: DriveOrder):
        self.root, self.preset, self.order = root, preset, order

    @cached_property
    def _rows(self) -> dict[str, list[dict[str, Any]]]:
        return json.loads((self.root / nuscenes.rows_path(self.order.scene)).read_text(encoding="utf-8"))

    @cached_property
    def _sample(self) -> dict[str, Any]:
        return self._rows["sample"][len(self._rows["sample"]) // 2]

    def _file(self, channel: str) -> Path:
        """The file that a sensor wrote."""
        return self.root / next(
            row["filename"]
            for row in self._rows["sample_data"]
            if row["sample_token"] == self._sample["token"] and row["filename"].startswith(f"samples/{channel}/")
        )

    def track(self) -> NDArray[np.float64]:
        """Where the car was (N, 2) when its first camera fired."""
        poses = {row["token"]: row["translation"][:2] for row in self._rows["ego_pose"]}
        channel = f"/{AROUND[0]}/"
        files = [row for row in self._rows["sample_data"] if channel in row["filename"]]
        return np.array([poses[row["ego_pose_token"]] for row in files])

    def image(self, channel: str) -> Rgb:
        """What a camera sees."""
        return read_rgb(self._file(channel), self.preset.width_px, self.preset.height_px)

    def truth(self) -> list[Rgb]:
        """Depth, classes and objects of the front cameras, and the image itself."""
        timestamp = self._file("CAM_FRONT").stem.split("__")[2]
        with np.load(self.root / "synth_gt" / self.order.scene / f"{timestamp}_CAM_FRONT.npz") as truth:
            depth, labels, instances = truth["depth"], truth["labels"], truth["instances"]
        colours = np.random.default_rng(0).integers(40, 256, (4096, 3)).astype(np.uint8)  # any, but different
        objects = np.where(instances[..., None] > 0, colours[instances % 4096], 0).astype(np.uint8)
        return [self.image("CAM_FRONT"), depth_image(depth), label_image(labels), objects]

    def from_above(self) -> list[Rgb]:
        """Lidar points by height and occupied voxels by class, the car's front upwards."""
        pictures = []
        if self.preset.lidar:
            points = np.fromfile(self._file("LIDAR_TOP"), np.float32).reshape(-1, 5)
            view = MapView((-REACH_M, REACH_M), (-REACH_M, REACH_M), pixel_m=2 * REACH_M / PLAN_PX)
            point_m = 0.25  # so that they show
            pictures.append(birds_eye(points[:, :3], height_colours(points[:, 2:3]), view, point_m))
        if self.preset.occupancy:
            with np.load(self.root / "gts" / self.order.scene / self._sample["token"] / "labels.npz") as labels:
                semantics = labels["semantics"]
            highest = semantics.shape[2] - 1 - np.argmax(semantics[..., ::-1] != FREE, axis=2)
            classes = np.take_along_axis(semantics, highest[..., None], 2)[..., 0]
            pictures.append(label_image(_LABELS[classes])[::-1, ::-1])
        return pictures


def _map(root: Path, preset: SynthPreset, location: str) -> Rgb:
    """The map picture of a city with the tracks of its drives."""
    grey = np.asarray(cv2.imread(str(root / nuscenes.map_path(location)), cv2.IMREAD_GRAYSCALE))
    picture = np.repeat((235 - grey // 3)[..., None], 3, axis=2).astype(np.uint8)  # streets a little darker than paper
    for order in (order for order in preset.drives if order.location == location):
        track = _Moment(root, preset, order).track() * PIXELS_A_METRE
        pixels = np.round(np.c_[track[:, 0], len(grey) - track[:, 1]]).astype(np.int32)
        cv2.polylines(picture, [pixels], False, ROLE_COLOURS[order.role], 25)
    return cv2.resize(picture, (PLAN_PX, PLAN_PX), interpolation=cv2.INTER_AREA).astype(np.uint8)


def _titled(title: str, images: Sequence[Rgb], height_px: int) -> list[Rgb]:
    return [title_strip(title, PAGE_PX), stack_rows([images], height_px=height_px)]
