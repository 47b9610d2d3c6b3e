"""How much of a data set to make."""

from dataclasses import dataclass, field

from presight_core.synthetic.style import CityStyle, Density


@dataclass(frozen=True)
class SynthPreset:
    """One data set: a city, its drives, and its images."""

    name: str
    style: CityStyle
    lights: tuple[str, ...]  # one drive each
    keyframes: int  # a drive, at 2 Hz
    width_px: int
    height_px: int
    route_count: int = 1  # different streets; drives take turns, so that later drives see streets again
    sweeps: bool = False  # also the images between keyframes, at 12 Hz
    location: str = "singapore-onenorth"  # one of the four map names that nuScenes knows
    density: Density = field(default_factory=Density)
    jpeg_quality: int = 92

    @property
    def moments(self) -> int:
        """Times a drive at which all six cameras fire."""
        return (self.keyframes - 1) * 6 + 1 if self.sweeps else self.keyframes


PRESETS = {
    "ci": SynthPreset(
        name="ci",
        style=CityStyle(size_m=200.0, spacing_m=90.0, margin_m=55.0),  # one block and its four streets
        lights=("day", "overcast"),
        keyframes=6,
        width_px=200,
        height_px=112,
        density=Density(vehicles=6, cyclists=1, pedestrians=10),
    ),
    "demo": SynthPreset(
        name="demo",
        style=CityStyle(size_m=340.0),
        lights=("day", "overcast", "day"),
        keyframes=24,
        width_px=400,
        height_px=225,
    ),
    "experiment": SynthPreset(
        name="experiment",
        style=CityStyle(size_m=700.0),
        lights=("day", "overcast", "day", "dusk") * 3,
        keyframes=40,
        width_px=400,
        height_px=225,
        route_count=4,
    ),
}
