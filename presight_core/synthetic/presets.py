"""How much of a data set to make: cities, drives, images and ground truth, as settings."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from pydantic import Field, model_validator

from presight_core.config import Count, Settings, merge, parse_overrides, validate
from presight_core.errors import SettingsError
from presight_core.nuscenes_split import PRIOR_SCENES, TEST_SCENES, Role
from presight_core.synthetic.style import GARDENS, HARBOUR, TOWERS, CityStyle, Density

Light = Literal["day", "overcast", "dusk", "night"]
# The official devkit knows these four maps and no other.
Location = Literal["boston-seaport", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown"]


class Town(Settings):
    """One city and the drives through it: each entry of `train`, `prior` and `test` is the light of one drive."""

    style: CityStyle = CityStyle()
    density: Density = Density()
    streets: Count = 1  # that drives take turns on, so that later drives see streets again
    new_streets: Annotated[int, Field(ge=0)] = 0  # more streets, which only test drives see
    train: tuple[Light, ...] = ()
    prior: tuple[Light, ...] = ()
    test: tuple[Light, ...] = ()

    @property
    def lights(self) -> dict[Role, tuple[Light, ...]]:
        """The light of each drive, by what the drives are for."""
        return {"train": self.train, "prior": self.prior, "test": self.test}


class SynthPreset(Settings):
    """One data set. Images are best 16:9: 400x225, 800x450 or 1600x900."""

    name: str
    towns: dict[Location, Town] = Field(min_length=1)
    version: Literal["v1.0-mini", "v1.0-trainval"] = "v1.0-mini"  # folder of the tables
    keyframes: Annotated[int, Field(ge=2)] = 24  # a drive, at 2 Hz
    width_px: Annotated[int, Field(ge=16, le=1600)] = 400
    height_px: Annotated[int, Field(ge=9, le=900)] = 225
    antialias: bool = True
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] = 92
    sweeps: bool = False  # also the images between keyframes, at 12 Hz
    lidar: bool = False  # LIDAR_TOP at keyframes
    occupancy: bool = False  # Occ3D labels of keyframes
    surface: bool = False  # a dense point set of each city's surfaces
    true_height: bool = False  # ego poses with the height of the ground; nuScenes says 0 everywhere
    paper_split: bool = False  # scene names say to which part of the paper's split a drive belongs

    @model_validator(mode="after")
    def _enough_scene_names(self) -> "SynthPreset":
        for role, names in _scene_names(self.paper_split).items():
            drives = sum(len(town.lights[role]) for town in self.towns.values())
            if drives > len(names):
                raise ValueError(f"{drives} {role} drives, but only {len(names)} scene names; take fewer drives")
        return self

    @property
    def moments(self) -> int:
        """Times a drive at which all six cameras fire."""
        return (self.keyframes - 1) * 6 + 1 if self.sweeps else self.keyframes

    @property
    def drives(self) -> tuple["DriveOrder", ...]:
        """All drives, town by town."""
        return tuple(_orders(self))


@dataclass(frozen=True)
class DriveOrder:
    """One drive to make."""

    number: int  # in the data set
    scene: str
    location: Location
    role: Role
    light: Light
    street: int  # of its town
    turn: int  # how many drives of its role came before it on this street


def load_preset(name: str, overrides: Iterable[str] = ()) -> SynthPreset:
    """A preset by its name, with `key=value` overrides such as `keyframes=40` or `towns.boston-seaport.streets=2`.

    Raises SettingsError for an unknown name or a value out of range.
    """
    if name not in PRESETS:
        raise SettingsError(f"preset {name!r} is unknown; choose one of {', '.join(PRESETS)}")
    values = merge(PRESETS[name].model_dump(), parse_overrides(overrides))
    return validate(SynthPreset, values, f"preset {name} with --set")


def _orders(preset: SynthPreset) -> Iterator[DriveOrder]:
    names = _scene_names(preset.paper_split)
    made = dict.fromkeys(names, 0)
    number = 0
    for location, town in preset.towns.items():
        for role, lights in town.lights.items():
            streets = town.streets + (town.new_streets if role == "test" else 0)
            for index, light in enumerate(lights):
                scene = names[role][made[role] if preset.paper_split else number]
                yield DriveOrder(number, scene, location, role, light, index % streets, index // streets)
                made[role] += 1
                number += 1


def _scene_names(paper_split: bool) -> dict[Role, tuple[str, ...]]:
    every = tuple(f"scene-{number:04d}" for number in range(1, 1111))  # as many as nuScenes has
    if not paper_split:
        return dict.fromkeys(("train", "prior", "test"), every)
    held_out = {*PRIOR_SCENES, *TEST_SCENES}
    return {
        "train": tuple(name for name in every if name not in held_out), "prior": PRIOR_SCENES, "test": TEST_SCENES,
    }  # fmt: skip


# Twelve drives; each street is seen twice, in different light.
_TRAINING_LIGHTS: tuple[Light, ...] = (
    "day", "overcast", "dusk", "day", "night", "overcast", "overcast", "day", "day", "night", "day", "dusk",
)  # fmt: skip


def _large(style: CityStyle) -> CityStyle:
    return replace(style, size_m=520.0)  # room for six streets of 150 m that hardly overlap


PRESETS = {
    "ci": SynthPreset(
        name="ci",
        towns={
            "singapore-onenorth": Town(
                style=CityStyle(size_m=200.0, spacing_m=90.0),  # one block and its four streets
                density=Density(vehicles=6, cyclists=1, pedestrians=10),
                train=("day", "overcast"),
            )
        },
        keyframes=6,
        width_px=200,
        height_px=112,
    ),
    "demo": SynthPreset(name="demo", towns={"singapore-onenorth": Town(train=("day", "overcast", "day"))}),
    "experiment": SynthPreset(
        name="experiment",
        towns={
            "boston-seaport": Town(style=_large(HARBOUR), streets=6, train=_TRAINING_LIGHTS),
            "singapore-queenstown": Town(style=_large(GARDENS), streets=6, train=_TRAINING_LIGHTS),
            "singapore-onenorth": Town(
                style=_large(TOWERS),
                streets=4,
                new_streets=1,  # a fifth of what test drives see is new: the paper's overlap is 80 %
                prior=("day", "overcast", "day", "overcast") * 2,  # night stays out of priors, as in the paper
                test=("day", "overcast", "dusk", "night", "day", "overcast", "day", "night"),
            ),
        },
        version="v1.0-trainval",
        keyframes=40,
        lidar=True,
        occupancy=True,
        surface=True,
        paper_split=True,
    ),
}
