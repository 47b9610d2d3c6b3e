"""What `presight features` does: fit a space over cities, draw a frame, report on a city's drives."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.console import print_json, print_table, progress_bars
from flows.plan import drive_frames, features_recipe, space_key
from presight_core import pictures
from presight_core.config import CitySettings, load_city_settings
from presight_core.drives import Drive, FrameTable, Reject
from presight_core.errors import InputError, NotFoundError, SettingsError
from presight_core.feature_space import FeatureSpace
from presight_core.images import read_rgb
from presight_core.masking import masked_labels, masked_share
from presight_core.pixels import FrameLayers
from presight_core.split import part_of
from storage.workspace import Workspace

STEPS = ("read", "prepare", "networks", "project", "store")
REPORT_COLUMNS = ("drive", "images", "rejects", "masked %", "features kB", "labels kB", "images/s", "busy %")
PANEL_WIDTH_PX = 640  # two rows of two fit a screen
MASK_COLOUR = (255, 0, 0)


@dataclass(frozen=True)
class View:
    """One camera image of a drive."""

    drive: str  # scene name or id
    camera: str
    index: int  # in order of time


def fit_cities(folder: Path, cities: list[str], overrides: list[str], as_json: bool) -> None:
    """Fit one feature space on all drives of the cities; the first one of its models is what builds use from now on.

    Raises SettingsError if the cities' settings ask for different models or channels.
    """
    from stages.features import FeatureExtractor
    from stages.space_fitting import SpaceImages, fit_space

    workspace = Workspace.open(folder).require()
    settings = [load_city_settings(workspace.city_file(city), overrides) for city in cities]
    keys = [space_key(chosen) for chosen in settings]
    if any(key != keys[0] for key in keys):
        raise SettingsError(f"{', '.join(cities)}: their settings name different feature models or channels; use --set")
    index = workspace.drives()
    drives = [
        (drive, drive_frames(index, drive.drive_id, chosen))
        for city, chosen in zip(cities, settings, strict=True)
        for drive in _drives_of(workspace, city)
        if part_of(drive.name, chosen.split) in chosen.split.build_from
    ]
    extractor = FeatureExtractor.load(settings[0].features, _cores())
    with progress_bars() as report:
        space = fit_space(SpaceImages(drives), extractor, settings[0].features, report)
    artifacts = workspace.artifacts()
    pinned = artifacts.pin_space(keys[0], artifacts.save_space(space))
    _print_space(space, pinned, as_json)


def _print_space(space: FeatureSpace, pinned: str, as_json: bool) -> None:
    is_pinned = pinned == space.space_id
    if as_json:
        explained = [round(float(share), 5) for share in space.explained]
        print_json({"space_id": space.space_id, "is_default": is_pinned, "default": pinned, "explained": explained})
        return
    first = ", ".join(f"{share:.1%}" for share in space.explained[:3])
    print(f"{space.space_id}: {space.channel_count} channels hold {space.explained.sum():.1%} of the variance")
    print(f"pictures show the first three as red, green and blue: {first}")
    if is_pinned:
        print("every city that uses this model uses this space from now on; next: presight build CITY")
    else:
        print(f"frozen before: {pinned}; to use the new one, say --set features.space={space.space_id}")


def show_frame(folder: Path, view: View, draw: bool, overrides: list[str]) -> None:
    """Print what is known of an image; `draw` writes a PNG into the workspace's reports and prints its path.

    Takes layers from the cache where they are, and else makes them for this image. Raises NotFoundError for a drive,
    camera or index that is not there, and without a feature space; InputError for an unusable image.
    """
    workspace = Workspace.open(folder).require()
    drive = _drive(workspace, view.drive)
    settings = load_city_settings(workspace.city_file(drive.city), overrides)
    frames = drive_frames(workspace.drives(), drive.drive_id, settings)
    row = _row(frames, view)
    space = _space(workspace, settings, drive.city)
    layers = _layers(workspace, settings, space, (drive, frames, row))
    rgb = read_rgb(Path(drive.root) / str(frames.path[row]), int(frames.width_px[row]), int(frames.height_px[row]))
    labels = masked_labels(layers.labels, rgb, settings.features)
    print(f"{drive.name} {view.camera} {view.index}: {frames.path[row]}")
    print(f"labels {_size(labels)}, masked {masked_share(labels, settings.features):.1%}; ", end="")
    print(f"features {_size(layers.features)} of space {space.space_id}")
    if draw:
        out = workspace.root / "reports" / "features" / f"{drive.name}-{view.camera}-{view.index:05d}.png"
        pictures.save_png(out, _picture(rgb, layers, labels, space, settings))
        print(out)


def report_city(folder: Path, city: str, overrides: list[str], as_json: bool) -> None:
    """Print a line a drive whose features are there. Raises NotFoundError without a feature space."""
    workspace = Workspace.open(folder).require()
    settings = load_city_settings(workspace.city_file(city), overrides)
    key = features_recipe(settings, _space(workspace, settings, city).space_id).digest
    drives = _drives_of(workspace, city)
    reports = [
        _drive_report(workspace, drive, settings, key)
        for drive in drives
        if workspace.features().is_complete(key, drive.drive_id)
    ]
    if as_json:
        print_json(reports)
        return
    rows = [
        (
            report["drive"],
            report["images"],
            len(report["rejects"]),
            f"{100 * report['masked_share']:.1f}",
            f"{report['feature_bytes'] / 1000:.1f}",
            f"{report['label_bytes'] / 1000:.1f}",
            f"{report.get('images/s', float('nan')):.2f}",
            " ".join(f"{name} {100 * report[name]:.0f}" for name in STEPS if name in report),
        )
        for report in reports
    ]
    print_table(f"{city}: features of {len(reports)} of {len(drives)} drives", REPORT_COLUMNS, rows)


def _drive_report(workspace: Workspace, drive: Drive, settings: CitySettings, key: str) -> dict[str, Any]:
    from storage.pixels import CachedPixels

    cache = workspace.features()
    frames = drive_frames(workspace.drives(), drive.drive_id, settings)
    rejects = cache.rejects(key, drive.drive_id)
    source = CachedPixels(frames, {drive.drive_id: drive.root}, cache, key, settings)
    usable = [row for row in range(len(frames)) if row not in rejects]
    shares = [masked_share(source.load_labels(row), settings.features) for row in usable]
    return {
        "drive": drive.name,
        "images": len(frames),
        "rejects": [f"{reject.file}: {reject.detail}" for reject in rejects.values()],
        "masked_share": float(np.mean(shares)) if shares else 0.0,
        **cache.figures(key, drive.drive_id),
    }


def _drives_of(workspace: Workspace, city: str) -> list[Drive]:
    drives = list(workspace.catalog().drives(city))
    if not drives:
        known = ", ".join(workspace.catalog().cities()) or "none yet"
        raise NotFoundError(f"{city}: no drives in {workspace.root}; cities known here: {known}; ingest them first")
    return drives


def _drive(workspace: Workspace, name: str) -> Drive:
    catalog = workspace.catalog()
    drives = [drive for city in catalog.cities() for drive in catalog.drives(city)]
    found = [drive for drive in drives if name in (drive.name, drive.drive_id)]
    if len(found) != 1:
        fact = "no drive of this name" if not found else f"{len(found)} drives: {', '.join(d.drive_id for d in found)}"
        known = ", ".join(drive.name for drive in drives[:10])
        raise NotFoundError(f"{name}: {fact}; give one of the names or ids, for example {known}")
    return found[0]


def _row(frames: FrameTable, view: View) -> int:
    rows = np.flatnonzero(frames.camera == view.camera)
    if not len(rows):
        raise NotFoundError(f"{view.drive}: no camera {view.camera}; it has {', '.join(np.unique(frames.camera))}")
    if view.index >= len(rows):
        raise NotFoundError(f"{view.drive}: {view.camera} has {len(rows)} images; give an index below that")
    return int(rows[np.argsort(frames.timestamp_us[rows], kind="stable")][view.index])


def _space(workspace: Workspace, settings: CitySettings, city: str) -> FeatureSpace:
    artifacts = workspace.artifacts()
    space_id = settings.features.space or artifacts.pinned_space(space_key(settings))
    if space_id is None:
        raise NotFoundError(f"{city}: no feature space yet; run `presight features fit {city}`")
    return artifacts.space(space_id)


def _layers(
    workspace: Workspace, settings: CitySettings, space: FeatureSpace, frame: tuple[Drive, FrameTable, int]
) -> FrameLayers:
    """Labels and features of a drive's row, from the cache or made now."""
    from stages.features import FeatureExtractor, extract_drive

    drive, frames, row = frame
    key, cache = features_recipe(settings, space.space_id).digest, workspace.features()
    if cache.is_complete(key, drive.drive_id):
        return cache.read(key, drive.drive_id, row)
    extractor = FeatureExtractor.load(settings.features, _cores())
    items: Iterator[Any] = extract_drive(drive, frames, space, extractor, settings.features, np.array([row]))
    _, layers = next(items)
    if isinstance(layers, Reject):
        raise InputError(f"{layers.file}: {layers.detail}; {layers.cure}")
    return layers


def _picture(
    rgb: NDArray[np.uint8], layers: FrameLayers, labels: NDArray[np.uint8], space: FeatureSpace, settings: CitySettings
) -> NDArray[np.uint8]:
    from presight_core import classes

    masked = classes.lookup(settings.features.dynamic_classes)[labels]
    rows = [
        [rgb, pictures.label_image(layers.labels)],
        [pictures.overlay(rgb, masked, MASK_COLOUR), space.picture(layers.features)],
    ]
    height_px = round(rgb.shape[0] * PANEL_WIDTH_PX / rgb.shape[1])
    panels = [[pictures.resize(image, PANEL_WIDTH_PX, height_px) for image in row] for row in rows]
    titles = ("image", "labels"), ("masked", "features, first three directions")
    return np.concatenate([pictures.stack_rows([row], title) for title, row in zip(titles, panels, strict=True)])


def _size(grid: NDArray[np.uint8]) -> str:
    return " x ".join(map(str, grid.shape))


def _cores() -> int:
    return len(os.sched_getaffinity(0))
