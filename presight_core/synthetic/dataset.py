"""Write a data set: drives through one synthetic city in the nuScenes format, with ground truth beside it.

root/samples, root/sweeps, root/maps, root/v1.0-mini    what nuScenes has
root/synth_gt/<scene>/<timestamp>_<camera>.npz          depth, labels, instances of each keyframe image
root/synth_gt/<scene>/rows.json                         that drive's table rows: written last, so it is complete
root/synth_gt/synth.json                                what the data set was made from
"""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from presight_core.cameras import Camera
from presight_core.errors import SettingsError
from presight_core.progress import Progress, Report, silent
from presight_core.synthetic import nuscenes
from presight_core.synthetic.actors import KINDS, Actor, foot_of
from presight_core.synthetic.city import City
from presight_core.synthetic.drive_plan import SWEEPS_A_KEYFRAME, DrivePlan, Shot, plan_drive
from presight_core.synthetic.map_picture import write_map_picture
from presight_core.synthetic.nuscenes import Rows
from presight_core.synthetic.presets import PRESETS, SynthPreset
from presight_core.synthetic.renderer import Renderer, Views
from presight_core.synthetic.rig import rig_camera
from presight_core.synthetic.shadow import Shadows

FORMAT = 1  # raise it when the same preset and seed would give other files
LOCATIONS = ("boston-seaport", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown")
ANNOTATED_M = 60.0  # objects farther from the car than this get no box
SHADOW_MARGIN_M = 130.0  # past the ends of a drive


def write_dataset(
    root: Path, preset: SynthPreset | str, seed: int, report: Report = silent, threads: int | None = None
) -> None:
    """Write the data set of a preset (or the name of one in PRESETS) and a seed into a folder.

    Drives that are already complete are kept, so an interrupted run is finished by running it again.
    Raises SettingsError for an unknown preset or location, and if the folder holds another data set.
    """
    preset = _resolve(preset)
    _claim(root, preset, seed)
    total = len(preset.lights) * preset.moments
    work = _Work(root, preset, seed, threads or os.cpu_count() or 1)
    for number in range(len(preset.lights)):
        if not work.is_complete(number):
            work.write_drive(number, lambda done, base=number * preset.moments: _tell(report, base + done, total))
        _tell(report, (number + 1) * preset.moments, total)
    work.write_tables()


def _tell(report: Report, done: int, total: int) -> None:
    report(Progress("synth", done, total))


def _resolve(preset: SynthPreset | str) -> SynthPreset:
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise SettingsError(f"preset {preset!r} is unknown; choose one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    if preset.location not in LOCATIONS:
        raise SettingsError(
            f"location {preset.location!r} is unknown to nuScenes; choose one of {', '.join(LOCATIONS)}"
        )
    return preset


def _claim(root: Path, preset: SynthPreset, seed: int) -> None:
    """Note what the folder is for, or refuse it if it is for something else."""
    wanted = json.loads(json.dumps({"format": FORMAT, "seed": seed, "preset": asdict(preset)}))
    stamp = root / "synth_gt" / "synth.json"
    if not stamp.exists():
        nuscenes.write_json(stamp, wanted)
        return
    found = json.loads(stamp.read_text(encoding="utf-8"))
    if found != wanted:
        made = f"preset {found.get('preset', {}).get('name')!r}, seed {found.get('seed')}, format {found.get('format')}"
        raise SettingsError(
            f"{root} holds another synthetic data set ({made}; wanted preset {preset.name!r}, seed {seed}, "
            f"format {FORMAT}); choose another folder, or delete this one"
        )


@dataclass(frozen=True)
class _Shooting:
    """One drive while it is rendered."""

    plan: DrivePlan
    shadows: Shadows
    root: Path
    preset: SynthPreset
    renderer: Renderer

    def take(self, shot: Shot) -> dict[int, tuple[float, float]]:
        """Render and write one image; returns pixels seen and pixels expected of each object in a keyframe."""
        plan, preset = self.plan, self.preset
        x, y, yaw = plan.pose(shot.time_s).tolist()
        # The car follows the ground, its recorded pose does not.
        world_from_ego = self.renderer.city.terrain.stand(x, y, yaw)
        camera = rig_camera(shot.mount, world_from_ego, preset.width_px, preset.height_px)
        actors = plan.traffic.actors(shot.time_s, np.array([x, y]))
        seed = (plan.noise_seed + 7919 * shot.moment + 101 * shot.mount.delay_us) % 2**31  # another grain each time
        views = self.renderer.render([camera], plan.lighting, actors, self.shadows, seed)
        self._write_image(shot, views)
        if not shot.is_keyframe:
            return {}
        self._write_truth(shot, views)
        return _pixels_of(actors, camera, views.instances[0])

    def _write_image(self, shot: Shot, views: Views) -> None:
        path = self.root / nuscenes.image_path(self.plan, shot)
        bgr = np.ascontiguousarray(views.rgb[0][..., ::-1])
        encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self.preset.jpeg_quality])[1]
        path.write_bytes(encoded.tobytes())

    def _write_truth(self, shot: Shot, views: Views) -> None:
        """Depth in half precision: 0.05 % of the depth, a tenth of what any method here resolves."""
        np.savez_compressed(
            self.root / nuscenes.truth_path(self.plan, shot),
            depth=views.depth_m[0].astype(np.float16),
            labels=views.labels[0],
            instances=views.instances[0],
        )


@dataclass
class _Work:
    """A data set in the making; the city is built only if something is left to do."""

    root: Path
    preset: SynthPreset
    seed: int
    threads: int

    @cached_property
    def city(self) -> City:
        return City(self.seed, self.preset.style)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.city)

    def _rows_file(self, number: int) -> Path:
        return self.root / "synth_gt" / f"scene-{number + 1:04d}" / "rows.json"

    def is_complete(self, number: int) -> bool:
        return self._rows_file(number).exists()

    def write_drive(self, number: int, report_moments: Callable[[int], None]) -> None:
        """Render all images of a drive side by side, then write its rows."""
        plan = plan_drive(self.city, self.preset, self.seed, number)
        shots = plan.shots(self.preset.sweeps)
        for path in {nuscenes.image_path(plan, shot) for shot in shots} | {nuscenes.truth_path(plan, shots[0])}:
            (self.root / path).parent.mkdir(parents=True, exist_ok=True)
        shadows = self.renderer.cast_shadows(plan.lighting, plan.middle, plan.reach_m + SHADOW_MARGIN_M)
        shooting = _Shooting(plan, shadows, self.root, self.preset, self.renderer)
        seen = []
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                for done, pixels in enumerate(pool.map(shooting.take, shots), 1):
                    seen.append(pixels)
                    report_moments(done // len(nuscenes.RIG))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        size_px = self.preset.width_px, self.preset.height_px
        boxes = _boxes(plan, shots, seen)
        nuscenes.write_json(
            self._rows_file(number), nuscenes.drive_rows(plan, self.preset.location, size_px, shots, boxes)
        )

    def write_tables(self) -> None:
        """Join the rows of all drives into the tables, and draw the map."""
        numbers = range(len(self.preset.lights))
        drives: list[Rows] = [json.loads(self._rows_file(number).read_text(encoding="utf-8")) for number in numbers]
        rows = nuscenes.merge([nuscenes.vocabulary_rows(), *drives])
        rows["map"] = [nuscenes.map_row(self.preset.location, rows["log"])]
        picture = self.root / rows["map"][0]["filename"]
        if not picture.exists():
            write_map_picture(picture, self.city)
        nuscenes.write_tables(self.root / nuscenes.VERSION, rows)


# ---- boxes -------------------------------------------------------------------------------------------------------


def _corners(actor: Actor) -> NDArray[np.float64]:
    """The eight corners (8, 3) of an actor's box, world metres."""
    kind = KINDS[actor.kind]
    signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (0.0, 1.0)])
    local = signs * [kind.length_m, kind.width_m, kind.height_m]
    c, s = np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)
    return local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + foot_of(actor)


def _pixels_of(actors: Sequence[Actor], camera: Camera, instances: NDArray[np.int32]) -> dict[int, tuple[float, float]]:
    """For each actor in front of a camera: pixels seen, and pixels that its box would fill if nothing hid it."""
    numbers, counts = np.unique(instances, return_counts=True)
    seen = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    image = shapely.box(0, 0, camera.width_px, camera.height_px)
    pixels = {}
    for actor in actors:
        projected, depth_m = camera.project(_corners(actor))
        if depth_m.min() > 0.1:  # partly behind the camera: its outline has no area there
            outline = shapely.MultiPoint(projected).convex_hull
            filled = 0.65 * outline.intersection(image).area  # a car fills about two thirds of its box's outline
            if filled > 1:
                pixels[actor.instance] = float(seen.get(actor.instance, 0)), float(filled)
    return pixels


def _boxes(
    plan: DrivePlan, shots: Sequence[Shot], seen: Sequence[dict[int, tuple[float, float]]]
) -> dict[int, list[nuscenes.Box]]:
    """Annotations of every keyframe: all actors within reach, seen or not, as nuScenes has them."""
    sums: dict[tuple[int, int], NDArray[np.float64]] = {}
    for shot, pixels in zip(shots, seen, strict=True):
        for instance, pair in pixels.items():
            key = shot.moment // SWEEPS_A_KEYFRAME, instance
            sums[key] = sums.get(key, np.zeros(2)) + pair
    boxes: dict[int, list[nuscenes.Box]] = {}
    for keyframe in range(plan.keyframes):
        time_s = (plan.keyframe_us(keyframe) - plan.start_us) / 1e6
        place = plan.pose(time_s)[:2]
        boxes[keyframe] = []
        for actor in plan.traffic.actors(time_s, place):
            if np.hypot(actor.x_m - place[0], actor.y_m - place[1]) < ANNOTATED_M:
                visible, expected = sums.get((keyframe, actor.instance), np.array([0.0, 1.0]))
                boxes[keyframe].append(_box(actor, float(min(visible / expected, 1.0))))
    return boxes


def _box(actor: Actor, visible_share: float) -> nuscenes.Box:
    kind = KINDS[actor.kind]
    x, y, foot_m = foot_of(actor).tolist()
    return nuscenes.Box(
        instance=actor.instance,
        category=kind.category,
        attribute=_attribute(actor),
        centre_m=(x, y, foot_m + kind.height_m / 2),
        size_m=(kind.width_m, kind.length_m, kind.height_m),
        yaw_rad=actor.yaw_rad,
        visible_share=visible_share,
    )


def _attribute(actor: Actor) -> str:
    """The one attribute that nuScenes gives an object; empty for what has none."""
    kind = KINDS[actor.kind]
    if kind.category.startswith("movable_object"):
        return ""
    if kind.category.startswith("human"):
        return "pedestrian.moving" if actor.motion == "moving" else "pedestrian.standing"
    if kind.category in ("vehicle.bicycle", "vehicle.motorcycle"):
        return "cycle.with_rider" if kind.has_rider else "cycle.without_rider"
    return f"vehicle.{actor.motion}"
