"""What a drive is before it is rendered: where the car is at every moment, and who else is about."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from presight_core.frames import planar_transform
from presight_core.synthetic.city import City
from presight_core.synthetic.graph import ROUTE_STEP_M, follow
from presight_core.synthetic.lighting import Lighting, sample_lighting
from presight_core.synthetic.presets import SynthPreset
from presight_core.synthetic.rig import RIG, Mount
from presight_core.synthetic.traffic import Traffic, plan_traffic

SWEEP_HZ = 12
SWEEPS_A_KEYFRAME = 6
FIRST_DAY = datetime(2018, 7, 2, 2, 0, tzinfo=UTC)  # ten in the morning in Singapore
PULSE_M, PULSE_RAD_PER_S = 0.8, 0.6  # the car goes half a metre a second faster and slower every ten seconds


@dataclass(frozen=True)
class Shot:
    """One image to take."""

    moment: int  # index of the firing of all six cameras
    mount: Mount
    time_s: float  # since the drive's first keyframe
    timestamp_us: int
    is_keyframe: bool


@dataclass(frozen=True)
class DrivePlan:
    """One drive: a pure function of city, preset, seed and number."""

    number: int
    name: str  # scene name
    light: str
    start_us: int
    route: NDArray[np.float64]  # (N, 2)
    start_m: float
    speed_mps: float
    keyframes: int
    lighting: Lighting
    traffic: Traffic
    noise_seed: int

    def pose(self, time_s: float) -> NDArray[np.float64]:
        """x, y, yaw of the car."""
        return _poses(self.route, self.start_m, self.speed_mps, np.array([time_s]))[0]

    def world_from_ego(self, time_s: float) -> NDArray[np.float64]:
        """The ego pose (4, 4) as nuScenes would record it: z = 0 on any ground."""
        x, y, yaw = self.pose(time_s).tolist()
        return planar_transform(x, y, yaw)

    def keyframe_us(self, keyframe: int) -> int:
        """Timestamp of a keyframe's sample."""
        return self.start_us + keyframe * 1_000_000 * SWEEPS_A_KEYFRAME // SWEEP_HZ

    @property
    def captured(self) -> str:
        """Date of the log."""
        return (FIRST_DAY + timedelta(microseconds=self.start_us) - _since_epoch(FIRST_DAY)).strftime("%Y-%m-%d")

    @property
    def middle(self) -> NDArray[np.float64]:
        """Where the car is halfway (2,)."""
        return self.pose(self.duration_s / 2)[:2]

    @property
    def duration_s(self) -> float:
        return (self.keyframes - 1) * SWEEPS_A_KEYFRAME / SWEEP_HZ

    @property
    def reach_m(self) -> float:
        """How far the car gets from `middle`."""
        ends = np.stack([self.pose(0.0)[:2], self.pose(self.duration_s)[:2]])
        return float(np.linalg.norm(ends - self.middle, axis=1).max())

    def shots(self, sweeps: bool) -> list[Shot]:
        """All images in order of their moments; without sweeps only keyframes."""
        step = 1 if sweeps else SWEEPS_A_KEYFRAME
        taken = []
        for moment in range(0, (self.keyframes - 1) * SWEEPS_A_KEYFRAME + 1, step):
            for mount in RIG:
                offset_us = moment * 1_000_000 // SWEEP_HZ + mount.delay_us
                is_keyframe = moment % SWEEPS_A_KEYFRAME == 0
                taken.append(Shot(moment, mount, offset_us / 1e6, self.start_us + offset_us, is_keyframe))
        return taken


def plan_drive(city: City, preset: SynthPreset, seed: int, number: int) -> DrivePlan:
    """The drive of this number. Drives of one route share its streets; every third comes back the other way."""
    route_number, pass_number = number % preset.route_count, number // preset.route_count
    path, start_m, length_m = _street_of(city, preset, np.random.default_rng([seed, 1, route_number]))
    rng = np.random.default_rng([seed, 2, number])
    is_return = pass_number % 3 == 2
    route = city.graph.route(path[::-1] if is_return else path, lane=int(rng.integers(2)))
    if is_return:
        start_m = len(route) * ROUTE_STEP_M - start_m - length_m
    duration_s = (preset.keyframes - 1) * SWEEPS_A_KEYFRAME / SWEEP_HZ
    speed_mps = length_m / max(duration_s, 1.0) * rng.uniform(0.93, 1.07)
    start_m = float(np.clip(start_m + rng.uniform(-4, 8), 4, len(route) * ROUTE_STEP_M - length_m * 1.1 - 4))
    times = np.linspace(0, duration_s, preset.moments)
    light = preset.lights[number]
    start = FIRST_DAY + timedelta(days=2 * number, hours=8 if light == "dusk" else int(rng.integers(6)))
    return DrivePlan(
        number=number,
        name=f"scene-{number + 1:04d}",
        light=light,
        start_us=int(_since_epoch(start) / timedelta(microseconds=1)),
        route=route,
        start_m=start_m,
        speed_mps=float(speed_mps),
        keyframes=preset.keyframes,
        lighting=sample_lighting(light, rng),
        traffic=plan_traffic(city, rng, _poses(route, start_m, speed_mps, times), duration_s, preset.density),
        noise_seed=int(rng.integers(2**30)),
    )


def _street_of(city: City, preset: SynthPreset, rng: np.random.Generator) -> tuple[list[int], float, float]:
    """The nodes of a route, where on it drives begin, and how far they go, in metres."""
    duration_s = max((preset.keyframes - 1) * SWEEPS_A_KEYFRAME / SWEEP_HZ, 1.0)
    length_m = duration_s * rng.uniform(6.0, 8.0)  # 25 km/h: town traffic
    nodes = 4
    path = city.graph.straightest_path(rng, int(rng.integers(len(city.graph.nodes))), nodes)
    while len(city.graph.route(path)) * ROUTE_STEP_M < length_m * 1.1 + 30:
        nodes += 1
        path = city.graph.straightest_path(rng, path[0], nodes)
    room_m = len(city.graph.route(path)) * ROUTE_STEP_M - length_m * 1.1
    return path, float(rng.uniform(10, room_m - 10)), float(length_m)


def _poses(
    route: NDArray[np.float64], start_m: float, speed_mps: float, time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    along_m = start_m + speed_mps * time_s + PULSE_M * np.sin(PULSE_RAD_PER_S * time_s)
    return follow(route, along_m)


def _since_epoch(moment: datetime) -> timedelta:
    return moment - datetime(1970, 1, 1, tzinfo=UTC)
