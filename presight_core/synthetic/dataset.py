"""Write a data set: drives through synthetic cities in the nuScenes format, with ground truth beside it.

root/samples, root/sweeps, root/maps, root/<version>    what nuScenes has
root/maps/expansion/<location>.json                     the vector map
root/gts/<scene>/<sample token>/labels.npz              occupancy, laid out as Occ3D has it
root/synth_gt/<scene>/<timestamp>_<camera>.npz          depth, labels, instances of each keyframe image
root/synth_gt/<scene>/rows.json                         that drive's table rows: written last, so it is complete
root/synth_gt/surface/<location>.npz                    a dense point set of the standing city
root/contact_sheet.png                                  one look at all of it
root/synth_gt/synth.json                                what the data set was made from
"""

import json
import os
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

from presight_core.errors import SettingsError
from presight_core.progress import Progress, Report, silent
from presight_core.synthetic import nuscenes
from presight_core.synthetic.annotations import Sightings, boxes_of
from presight_core.synthetic.city import City
from presight_core.synthetic.compile_ahead import ShaderAhead
from presight_core.synthetic.contact_sheet import draw_contact_sheet
from presight_core.synthetic.drive_plan import DrivePlan, Shot, Stretch, Turn, plan_drive, plan_streets
from presight_core.synthetic.files import write_json
from presight_core.synthetic.map_expansion import write_map_expansion
from presight_core.synthetic.map_picture import write_base_map, write_map_picture
from presight_core.synthetic.nuscenes import Rows
from presight_core.synthetic.occupancy import CitySurfaces
from presight_core.synthetic.presets import DriveOrder, Location, SynthPreset, load_preset
from presight_core.synthetic.renderer import Renderer
from presight_core.synthetic.rig import RIG
from presight_core.synthetic.shooting import Shooting
from presight_core.synthetic.surface_points import Bounds, exposed, sample_surface, write_surface_points

FORMAT = 2  # raise it when the same preset and seed would give other files
STAMP = "synth_gt/synth.json"  # what the folder is for
SURFACE_SPACING_M = 0.25  # finer than the voxels of a prior, 0.4 m
SHADOW_MARGIN_M = 130.0  # past the ends of a drive


def write_dataset(
    root: Path, preset: SynthPreset | str, seed: int, report: Report = silent, threads: int | None = None
) -> None:
    """Write the data set of a preset (or the name of one in PRESETS) and a seed into a folder.

    Drives that are already complete are kept, so an interrupted run is finished by running it again.
    Raises SettingsError for an unknown preset, and if the folder holds another data set.
    """
    preset = load_preset(preset) if isinstance(preset, str) else preset
    _claim(root, preset, seed)
    shade = ShaderAhead()
    total = len(preset.drives) * preset.moments
    done = 0

    def tell(moments: int) -> None:
        report(Progress("synth", done + moments, total))

    for location in preset.towns:
        town = _TownWork(root, preset, location, seed, shade, threads or os.cpu_count() or 1)
        for order in (order for order in preset.drives if order.location == location):
            if not town.is_complete(order):
                town.write_drive(order, tell)
            done += preset.moments
            tell(0)
        town.write_maps()
    _write_tables(root, preset)
    draw_contact_sheet(root, preset)


def city_of(root: Path, location: Location) -> City:
    """A city of the data set in a folder, built again from what the folder says of itself."""
    stamp = json.loads((root / STAMP).read_text(encoding="utf-8"))
    return _build_city(SynthPreset(**stamp["preset"]), stamp["seed"], location)


def _build_city(preset: SynthPreset, seed: int, location: Location) -> City:
    locations = get_args(Location)
    return City(seed * len(locations) + locations.index(location), preset.towns[location].style)


def _claim(root: Path, preset: SynthPreset, seed: int) -> None:
    """Note what the folder is for, or refuse it if it is for something else."""
    wanted = {"format": FORMAT, "seed": seed, "preset": preset.model_dump(mode="json")}
    stamp = root / STAMP
    if not stamp.exists():
        write_json(stamp, wanted)
        return
    found = json.loads(stamp.read_text(encoding="utf-8"))
    if found != wanted:
        raise SettingsError(
            f"{root} holds another synthetic data set: {'; '.join(_differences(found, wanted))}; "
            "choose another folder, or delete this one"
        )


def _differences(found: Any, wanted: Any, name: str = "") -> list[str]:
    """What differs between two nested settings, one line each: `name is this, wanted that`."""
    if not (isinstance(found, dict) and isinstance(wanted, dict)):
        return [] if found == wanted else [f"{name} is {found!r}, wanted {wanted!r}"]
    prefix = f"{name}." if name else ""
    keys = sorted({*found, *wanted})
    return [line for key in keys for line in _differences(found.get(key), wanted.get(key), f"{prefix}{key}")]


@dataclass
class _TownWork:
    """One city of a data set in the making; it is built only if something is left to do."""

    root: Path
    preset: SynthPreset
    location: Location
    seed: int
    shade: ShaderAhead
    threads: int

    @cached_property
    def city(self) -> City:
        return _build_city(self.preset, self.seed, self.location)

    @cached_property
    def streets(self) -> tuple[Stretch, ...]:
        return plan_streets(self.city, self.preset.towns[self.location], self.preset.keyframes)

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer(self.city, self.preset.antialias, self.shade)

    @cached_property
    def surfaces(self) -> CitySurfaces:
        return CitySurfaces(self.city)

    def is_complete(self, order: DriveOrder) -> bool:
        return (self.root / nuscenes.rows_path(order.scene)).exists()

    def write_drive(self, order: DriveOrder, tell: Callable[[int], None]) -> None:
        """Take everything of a drive side by side, then write its rows."""
        preset = self.preset
        plan = plan_drive(self.city, preset, self.streets, order)
        shots, turns = plan.shots(preset.sweeps), plan.turns(preset.sweeps and preset.lidar)
        size_px = preset.width_px, preset.height_px
        files = nuscenes.recordings(plan, shots, turns if preset.lidar else [], size_px)
        for path in {file.path for file in files} | {nuscenes.truth_path(plan, shots[0])}:
            (self.root / path).parent.mkdir(parents=True, exist_ok=True)
        sightings = self._take(plan, shots, turns, tell)
        boxes = {keyframe: boxes_of(plan, keyframe, sightings[keyframe]) for keyframe in range(plan.keyframes)}
        write_json(self.root / nuscenes.rows_path(order.scene), nuscenes.drive_rows(plan, files, size_px, boxes))

    def _take(
        self, plan: DrivePlan, shots: list[Shot], turns: list[Turn], tell: Callable[[int], None]
    ) -> dict[int, Sightings]:
        """Everything of a drive, in order of time; returns what the sensors saw at each keyframe."""
        shadows = self.renderer.cast_shadows(plan.lighting, plan.middle, plan.reach_m + SHADOW_MARGIN_M)
        shooting = Shooting(plan, self.preset, self.root, self.renderer, shadows, self.surfaces)
        events: list[Shot | Turn] = sorted([*shots, *turns], key=lambda event: event.timestamp_us)
        seen: dict[int, Sightings] = defaultdict(Sightings)
        images = 0
        with ThreadPoolExecutor(self.threads) as pool:
            try:
                for event, sightings in zip(events, pool.map(shooting.take, events), strict=True):
                    seen[event.keyframe].add(sightings)
                    images += isinstance(event, Shot)
                    tell(images // len(RIG))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return seen

    def write_maps(self) -> None:
        """The city's map as pictures and vectors, and its surface, where they are missing."""
        maps = self.root / "maps"
        for file, write in (
            (self.root / nuscenes.map_path(self.location), write_map_picture),
            (maps / "basemap" / f"{self.location}.png", write_base_map),
            (maps / "expansion" / f"{self.location}.json", write_map_expansion),
        ):
            if not file.exists():
                write(file, self.city)
        surface = self.root / "synth_gt" / "surface" / f"{self.location}.npz"
        if self.preset.surface and not surface.exists():
            self._write_surface(surface)

    def _write_surface(self, file: Path) -> None:
        size_m = self.city.style.size_m
        bounds = Bounds((0.0, 0.0, -5.0), (size_m, size_m, 20.0))  # as high as priors reach, and no skyline
        samples = sample_surface(self.city.mesh, SURFACE_SPACING_M, bounds)
        file.parent.mkdir(exist_ok=True)
        write_surface_points(file, samples.select(exposed(samples, self.surfaces.caster)))


def _write_tables(root: Path, preset: SynthPreset) -> None:
    """Join the rows of all drives into the tables."""
    drives: list[Rows] = [
        json.loads((root / nuscenes.rows_path(order.scene)).read_text(encoding="utf-8")) for order in preset.drives
    ]
    rows = nuscenes.merge([nuscenes.vocabulary_rows(preset.lidar), *drives])
    rows["map"] = [nuscenes.map_row(location, rows["log"]) for location in preset.towns]
    nuscenes.write_tables(root / preset.version, rows)
