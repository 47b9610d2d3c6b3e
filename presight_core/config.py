"""Settings: frozen models, presets, a TOML file per city, overrides from the command line.

Values are resolved in this order, later ones win: the preset, the city's TOML, `--set` overrides.
An unknown name is an error that names the file, the field and the nearest valid name.
"""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from presight_core import classes
from presight_core.errors import SettingsError

PRESETS = ("demo", "fast", "default", "paper")

Count = Annotated[int, Field(gt=0)]
Metres = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class Settings(BaseModel):
    """Base of all settings: immutable, and no unknown names."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FeatureSettings(Settings):
    """How images become label maps and features."""

    masks: Literal["auto", "precomputed", "model"] = "auto"  # auto: `segmentation/` of the data set where present
    segmentation_model: str = "tiny"  # name of a shipped model, or path of a model card
    feature_model: str = "tiny"  # likewise
    channels: Count = 64  # of the shared feature space; a model with fewer channels gives fewer
    sample_patches: Count = 200_000  # patches that give each channel of the feature space its range
    space: str | None = None  # id of a fitted space; None: the first one that was fitted for these models
    cache: Literal["exact", "compact"] = "compact"  # compact: 60 kB an image; no field can tell (decision 010)
    parked_cars: Literal["drop", "keep"] = "drop"  # keep: vehicles that stand still between two frames are mapped
    dynamic_classes: tuple[str, ...] = classes.DYNAMIC
    dynamic_margin: Share = 0.005  # of the image's height, around what can move: labels are rough at edges
    mask_shadows: bool = False  # mask dark ground next to what can move, too


class TilingSettings(Settings):
    """How a city is cut into tiles, and a tile into sub-fields."""

    tile_count: Count | None = None  # None: from the mapped area
    tile_area_km2: Metres = 1.0  # paper, section 3.2
    overlap_m: Annotated[float, Field(ge=0)] = 30.0  # frames this far outside a tile's cell still train it
    sub_field_count: Count = 8  # paper: 8 or 16 a tile
    box_quantile: Annotated[float, Field(ge=0, lt=0.5)] = 0.05  # box = 5..95 % of the member cameras (released code)
    box_margin_xy_m: Metres = 15.0
    box_margin_below_m: Metres = 5.0
    box_margin_above_m: Metres = 15.0
    seed: int = 0


class GridSettings(Settings):
    """One multi-resolution hash grid."""

    levels: Count
    features_per_level: Count
    min_resolution: Count = 16
    max_resolution: Count
    log2_rows: Annotated[int, Field(ge=4, le=24)]


class FieldSettings(Settings):
    """The scene representation of a tile (paper, section 3.2 and released code)."""

    grid: GridSettings = GridSettings(levels=10, features_per_level=4, max_resolution=16384, log2_rows=20)
    proposals: tuple[GridSettings, ...] = (
        GridSettings(levels=8, features_per_level=1, max_resolution=1024, log2_rows=20),
        GridSettings(levels=8, features_per_level=1, max_resolution=4096, log2_rows=20),
    )
    hidden_width: Count = 64
    proposal_width: Count = 64  # hidden units of the proposal networks (paper: 64 everywhere)
    geometry_channels: Count = 15
    video_embedding: Annotated[int, Field(ge=0)] = 12
    image_embedding: Annotated[int, Field(ge=0)] = 4
    lens_falloff: bool = False  # learn how much darker each camera's images are in their corners; not of the paper
    density_bias: float = -4.0  # metres; the released code, whose poses are scaled by 0.05, needs none


class SamplingSettings(Settings):
    """Where samples lie along a ray. Spacing is linear up to `linear_m`, then in disparity."""

    near_m: Metres = 0.1
    far_m: Metres = 1000.0
    linear_m: Metres = 100.0
    proposal_samples: tuple[Count, ...] = (128, 64)
    field_samples: Count = 64
    padding: Annotated[float, Field(ge=0)] = 0.01  # added to every proposal weight before sampling (released code)
    floor_m: Metres | None = None  # rays end where no ground can be: this far below the camera; None: as the paper
    floor_slope: Share = 0.1  # the floor falls away this steeply: the ground of the steepest street stays above it


class LossSettings(Settings):
    """Weights of the five losses besides rgb, whose weight is 1 (paper, section 3.2)."""

    features: float = 0.5
    sky: float = 0.001
    interlevel: float = 1.0
    distortion: float = 0.002


class GroundSettings(Settings):
    """Where the road must be: as far below the cameras that passed as they are mounted above it. Not of the paper."""

    weight: Annotated[float, Field(ge=0)] = 0.0  # of the loss; 0: nothing is known of the ground, as in the paper
    camera_height_m: Metres = 1.53  # above the road; the mean of nuScenes' six cameras
    tolerance_m: Metres = 0.1  # the road lies within this of where it must be
    curb_m: Annotated[float, Field(ge=0)] = 0.2  # sidewalks may be this much higher
    reach_m: Metres = 20.0  # only ground this near to a camera, on the map, is known


class StereoSettings(Settings):
    """How far surfaces are, from neighbouring images alone, before training (`stages/stereo.py`). Not of the paper."""

    weight: Annotated[float, Field(ge=0)] = 0.0  # of the loss; 0: nothing is known, as in the paper
    fades_from: Annotated[int, Field(ge=0)] = 1000  # step from which on they count evenly less, at the end nothing
    tolerance: Share = 0.015  # of the distance: rays end within it
    width_px: Count = 400  # at which images are compared


class TrainingSettings(Settings):
    """How a tile's field is optimised."""

    steps: Count = 100_000
    batch_rays: Count = 65_536
    learning_rate: Metres = 0.01
    warmup: Share = 0.1  # share of the steps with rising learning rate
    decay_at: tuple[Share, ...] = (0.25, 0.5, 0.75)
    decay: Share = 0.33
    beta2: Annotated[float, Field(gt=0, lt=1)] = 0.999  # of AdamW; Instant-NGP: 0.99
    weight_decay: float = 1e-5  # not on hash tables
    anneal: Share = 0.1  # share of the steps over which proposal weights sharpen
    thin_weight: Annotated[float, Field(ge=1)] = 1.0  # how much likelier pixels of poles, signs and fences are drawn
    fade_m: Annotated[float, Field(ge=0)] = 0.0  # nearer than this, gradients fade with the square of the distance
    features_shape: bool = True  # whether features decide where surfaces are, or colours alone
    image_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    keyframes_only: bool = False
    holdout_every: Annotated[int, Field(ge=0)] = 8  # every 8th frame of a camera is kept for evaluation; 0: none
    bfloat16: bool = True  # multilayer perceptrons, where the device is faster with it (threads.has_fast_bfloat16)
    checkpoint_every: Count = 2000
    seed: int = 0
    loss: LossSettings = LossSettings()
    ground: GroundSettings = GroundSettings()
    stereo: StereoSettings = StereoSettings()


SurfaceRule = Literal["first-hit", "expected", "span"]  # what they mean: field.surface.find_surface


class ExtractionSettings(Settings):
    """How a trained field becomes voxels."""

    surface: SurfaceRule = "first-hit"  # paper: first-hit; released code: expected depth
    features: Literal["field", "images"] = "field"  # of voxels; paper: what the field says there (docs/decisions/016)
    frame_stride: Count = 8  # every n-th training frame of a camera
    pixel_stride: Count = 5
    min_depth_m: Metres = 0.5
    max_depth_m: Metres = 50.0
    below_camera_m: Metres = 3.0
    above_camera_m: Metres = 6.0
    fog_density: Annotated[float, Field(ge=0)] = 0.0  # per metre: rays go through what is thinner; 0: as in the paper
    min_density: float = 0.05  # per metre; mean of the three networks (1.0 in the released code's scaled units)
    min_hits: Count = 2  # released code drops voxels with the minimum hit count


class ValidationSettings(Settings):
    """What a new tile must show before it may be published: by itself, then against the tile that it replaces.

    Both builds are compared where both saw: by the voxels of the drives that both have.
    """

    min_voxels: Count = 100
    min_psnr_db: float = 12.0  # held-out; below this the field shows nothing recognisable
    min_coverage: Share = 0.8  # share of the old tile's observed columns that the new one must keep
    min_geometry: Share = 0.6  # share of the voxels that lie within one voxel of the other build's, both ways
    min_feature_cosine: Annotated[float, Field(ge=-1, le=1)] = 0.5  # of centred features of common voxels, the median
    max_psnr_loss_db: Annotated[float, Field(ge=0)] = 2.0  # held-out, of the drives that both builds have


class UpdateSettings(Settings):
    """When and for how long `presight update` trains a tile on from the field that it has."""

    warm_steps_share: Share = 0.4  # of training.steps; 0: always from nothing
    max_outside: Share = 0.1  # of the cameras, outside the boxes of the field: there its grids are coarse


class SplitSettings(Settings):
    """Which drives are for what, by scene name or pattern ("scene-00*"). Drives of the test part never make a prior."""

    named: Literal["paper"] | None = None  # a split that ships with PreSight; instead of the lists
    train: tuple[str, ...] = ()
    prior: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    rest: Literal["train", "prior", "test"] | None = None  # part of drives on no list; None: prior without any split
    build_from: tuple[Literal["train", "prior"], ...] = ("train", "prior")  # parts whose drives make the prior
    overlap_m: Metres = 30.0  # half the length of the window that maps are drawn in: nearer places show the same ground
    allow_overlap: bool = False  # of the ground of train and test drives


class ResourceSettings(Settings):
    """What a tile asks of the cluster that builds it (`--runner dask`); it changes no prior."""

    cores: Count = 4
    gpus: Annotated[int, Field(ge=0, le=1)] = 1
    memory_gib: Annotated[float, Field(gt=0)] = 8.0  # a training of 40,000 images takes 3.4 GiB, its extraction less


class CitySettings(Settings):
    """Everything that decides a city's priors."""

    preset: Literal["demo", "fast", "default", "paper"] = "default"
    split: SplitSettings = SplitSettings()
    features: FeatureSettings = FeatureSettings()
    tiling: TilingSettings = TilingSettings()
    field: FieldSettings = FieldSettings()
    sampling: SamplingSettings = SamplingSettings()
    training: TrainingSettings = TrainingSettings()
    extraction: ExtractionSettings = ExtractionSettings()
    validation: ValidationSettings = ValidationSettings()
    update: UpdateSettings = UpdateSettings()
    resources: ResourceSettings = ResourceSettings()


class WorkspaceSettings(Settings):
    """Where things are kept: `presight.toml` of the workspace. None stands for a folder of the workspace."""

    catalog: str | None = None  # SQLAlchemy URL
    store: str | None = None  # folder or object-store URL of the prior store
    caches: str | None = None  # folder for frames, features and training scratch
    lease_s: Annotated[float, Field(ge=1)] = 60.0  # a build that is silent for so long is taken for dead


SettingsType = TypeVar("SettingsType", bound=Settings)


def load_city_settings(file: Path | None, overrides: Iterable[str] = ()) -> CitySettings:
    """Settings of a city from its preset, its TOML file (may be absent) and `key=value` overrides.

    Raises SettingsError for an unreadable file, an unknown name or a value out of range.
    """
    chosen = read_toml(file) if file is not None and file.exists() else {}
    source = str(file) if chosen else "the defaults"
    if overrides := list(overrides):
        chosen = merge(chosen, parse_overrides(overrides))
        source = f"{source} with --set"
    preset = chosen.get("preset", "default")
    if preset not in PRESETS:
        raise SettingsError(f"{source}: preset: {preset!r} is unknown; choose one of {', '.join(PRESETS)}")
    return validate(CitySettings, merge(_preset(preset), chosen), source)


def load_workspace_settings(file: Path) -> WorkspaceSettings:
    """Settings of a workspace from `presight.toml`; an absent file gives the defaults."""
    return validate(WorkspaceSettings, read_toml(file) if file.exists() else {}, str(file))


def read_toml(file: Path) -> dict[str, Any]:
    """The table of a TOML file. Raises SettingsError if it cannot be read or parsed."""
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"{file}: {error}; correct the file") from error


def validate(model: type[SettingsType], values: Mapping[str, Any], source: str) -> SettingsType:
    """The settings model filled with `values`; `source` is named in every error."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = "; ".join(_explain(model, problem) for problem in error.errors())
        raise SettingsError(f"{source}: {problems}") from None


def _preset(name: str) -> dict[str, Any]:
    text = resources.files("presight_core").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings with those of `top` laid over those of `base`."""
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = merge(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return merged


def parse_overrides(overrides: Iterable[str]) -> dict[str, Any]:
    """Nested settings of `a.b=value` texts. Raises SettingsError for a text that says nothing, or two things."""
    values: dict[str, Any] = {}
    for override in overrides:
        _set(values, override)
    return values


def _set(values: dict[str, Any], override: str) -> None:
    """Put `a.b=value` into nested `values`; the value is TOML, or a bare string."""
    key, separator, text = override.partition("=")
    if not separator:
        raise SettingsError(f"--set {override}: no '='; write --set section.name=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *sections, name = key.strip().split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise SettingsError(f"--set {override}: {section} is a value, not a section")
    values[name] = value


def _explain(model: type[BaseModel], problem: Any) -> str:
    """One pydantic error as `field: fact; cure`."""
    path = [str(part) for part in problem["loc"]]
    if problem["type"] != "extra_forbidden":
        return f"{'.'.join(path)}: {problem['msg']} (got {problem['input']!r})"
    names = _field_names(model, path[:-1])
    near = difflib.get_close_matches(path[-1], names, n=1)
    cure = f"did you mean {near[0]}?" if near else f"valid names: {', '.join(names)}"
    return f"{'.'.join(path)}: unknown setting; {cure}"


def _field_names(model: type[BaseModel], path: list[str]) -> list[str]:
    for part in path:
        annotation = model.model_fields[part].annotation if part in model.model_fields else None
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            break
        model = annotation
    return sorted(model.model_fields)
