"""What a drive is before it is rendered: where the car is at every moment, and who else is about."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from presight_core.synthetic.city import City
from presight_core.synthetic.graph import ROUTE_STEP_M, follow
from presight_core.synthetic.ground import Terrain
from presight_core.synthetic.lighting import Lighting, sample_lighting
from presight_core.synthetic.presets import DriveOrder, SynthPreset, Town
from presight_core.synthetic.rig import RIG, Mount
from presight_core.synthetic.traffic import Traffic, plan_traffic

SWEEP_HZ = 12
SWEEPS_A_KEYFRAME = 6
TURN_US = 50_000  # the lidar turns at 20 Hz
TURNS_A_KEYFRAME = 10
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
FIRST_DAY = datetime(2018, 7, 2, 2, 0, tzinfo=UTC)  # ten in the morning in Singapore
_HOURS = {"day": 0, "overcast": 0, "dusk": 8, "night": 11}  # later than that; 0: any time of the day
PULSE_M, PULSE_RAD_PER_S = 0.8, 0.6  # the car goes half a metre a second faster and slower every ten seconds


@dataclass(frozen=True)
class Shot:
    """One image to take."""

    moment: int  # index of the firing of all six cameras
    mount: Mount
    time_s: float  # since the drive's first keyframe
    timestamp_us: int
    is_keyframe: bool

    @property
    def keyframe(self) -> int:
        """The keyframe that it belongs to: itself, or the one that comes next."""
        return -(-self.moment // SWEEPS_A_KEYFRAME)


@dataclass(frozen=True)
class Turn:
    """One turn of the lidar."""

    number: int
    time_s: float  # since the drive's first keyframe
    timestamp_us: int
    is_keyframe: bool

    @property
    def keyframe(self) -> int:
        """The keyframe that it belongs to: itself, or the one that comes next."""
        return -(-self.number // TURNS_A_KEYFRAME)


@dataclass(frozen=True)
class Stretch:
    """What drives take of a street: nodes of the street graph, where on their route it begins, and how far it goes."""

    path: tuple[int, ...]
    start_m: float
    length_m: float


@dataclass(frozen=True)
class DrivePlan:
    """One drive: a pure function of city, preset, seed and order."""

    order: DriveOrder
    start_us: int
    route: NDArray[np.float64]  # (N, 2)
    start_m: float
    speed_mps: float
    keyframes: int
    lighting: Lighting
    traffic: Traffic
    terrain: Terrain
    true_height: bool  # recorded, not 0
    noise_seed: int

    @property
    def name(self) -> str:
        return self.order.scene

    def pose(self, time_s: float) -> NDArray[np.float64]:
        """x, y, yaw of the car."""
        return _poses(self.route, self.start_m, self.speed_mps, np.array([time_s]))[0]

    def world_from_ego(self, time_s: float) -> NDArray[np.float64]:
        """Where the car really is (4, 4): it stands on the ground and tilts with it."""
        return self.terrain.stand(*self.pose(time_s).tolist())

    def recorded_pose(self, time_s: float) -> NDArray[np.float64]:
        """The ego pose (4, 4) of the tables: as in nuScenes true but for the height, which is 0 on any ground."""
        pose = self.world_from_ego(time_s)
        if not self.true_height:
            pose[2, 3] = 0.0
        return pose

    def keyframe_us(self, keyframe: int) -> int:
        """Timestamp of a keyframe's sample."""
        return self.start_us + keyframe * 1_000_000 * SWEEPS_A_KEYFRAME // SWEEP_HZ

    def keyframe_s(self, keyframe: int) -> float:
        """When a keyframe is, seconds since the first."""
        return (self.keyframe_us(keyframe) - self.start_us) / 1e6

    @property
    def captured(self) -> str:
        """Date of the log."""
        return (EPOCH + timedelta(microseconds=self.start_us)).strftime("%Y-%m-%d")

    @property
    def middle(self) -> NDArray[np.float64]:
        """Where the car is halfway (2,)."""
        return self.pose(self.duration_s / 2)[:2]

    @property
    def duration_s(self) -> float:
        return self.keyframe_s(self.keyframes - 1)

    @property
    def reach_m(self) -> float:
        """How far the car gets from `middle`."""
        track = np.stack([self.pose(time_s)[:2] for time_s in np.linspace(0.0, self.duration_s, 20)])
        return float(np.linalg.norm(track - self.middle, axis=1).max())

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

    def turns(self, sweeps: bool) -> list[Turn]:
        """All turns of the lidar; without sweeps only keyframes."""
        step = 1 if sweeps else TURNS_A_KEYFRAME
        return [
            Turn(number, number * TURN_US / 1e6, self.start_us + number * TURN_US, number % TURNS_A_KEYFRAME == 0)
            for number in range(0, (self.keyframes - 1) * TURNS_A_KEYFRAME + 1, step)
        ]


def plan_streets(city: City, town: Town, keyframes: int) -> tuple[Stretch, ...]:
    """The streets of a town's drives, the ones that only test drives see last; they overlap as little as may be."""
    rng = np.random.default_rng([city.seed, 1])
    streets: list[Stretch] = []
    taken = np.zeros((0, 2))  # points along the streets so far
    for _ in range(town.streets + town.new_streets):
        candidates = [_random_street(city, keyframes, rng) for _ in range(12)]
        tracks = [_points_along(city, street) for street in candidates]
        best = int(np.argmin([_overlap(track, taken) for track in tracks]))
        streets.append(candidates[best])
        taken = np.r_[taken, tracks[best]]
    return tuple(streets)


def plan_drive(city: City, preset: SynthPreset, streets: tuple[Stretch, ...], order: DriveOrder) -> DrivePlan:
    """One drive along its street; some come back the other way."""
    street = streets[order.street]
    rng = np.random.default_rng([city.seed, 2, order.number])
    is_return = (order.street + order.turn) % 3 == 2
    path = list(street.path[::-1] if is_return else street.path)
    route = city.graph.route(path, lane=int(rng.integers(2)))
    start_m = len(route) * ROUTE_STEP_M - street.start_m - street.length_m if is_return else street.start_m
    duration_s = _duration_s(preset.keyframes)
    speed_mps = street.length_m / duration_s * rng.uniform(0.93, 1.07)
    last_m = len(route) * ROUTE_STEP_M - street.length_m * 1.1 - 4  # so that the fastest drive ends on its route
    start_m = float(np.clip(start_m + rng.uniform(-4, 8), 4, last_m))
    times = np.linspace(0, duration_s, preset.moments)
    start = FIRST_DAY + timedelta(days=2 * order.number, hours=_HOURS[order.light] or int(rng.integers(6)))
    density = preset.towns[order.location].density
    return DrivePlan(
        order=order,
        start_us=int((start - EPOCH) / timedelta(microseconds=1)),
        route=route,
        start_m=start_m,
        speed_mps=float(speed_mps),
        keyframes=preset.keyframes,
        lighting=sample_lighting(order.light, rng),
        traffic=plan_traffic(city, rng, _poses(route, start_m, speed_mps, times), duration_s, density),
        terrain=city.terrain,
        true_height=preset.true_height,
        noise_seed=int(rng.integers(2**30)),
    )


def _duration_s(keyframes: int) -> float:
    return (keyframes - 1) * SWEEPS_A_KEYFRAME / SWEEP_HZ


def _random_street(city: City, keyframes: int, rng: np.random.Generator) -> Stretch:
    length_m = _duration_s(keyframes) * rng.uniform(6.0, 8.0)  # 25 km/h: town traffic
    nodes = 4
    path = city.graph.straightest_path(rng, int(rng.integers(len(city.graph.nodes))), nodes)
    while len(city.graph.route(path)) * ROUTE_STEP_M < length_m * 1.1 + 30:
        nodes += 1
        path = city.graph.straightest_path(rng, path[0], nodes)
    room_m = len(city.graph.route(path)) * ROUTE_STEP_M - length_m * 1.1
    return Stretch(tuple(path), float(rng.uniform(10, room_m - 10)), float(length_m))


def _points_along(city: City, street: Stretch) -> NDArray[np.float64]:
    """Points (N, 2) every five metres."""
    first, last = int(street.start_m / ROUTE_STEP_M), int((street.start_m + street.length_m) / ROUTE_STEP_M)
    return city.graph.route(list(street.path))[first : last + 1 : 10]


def _overlap(track: NDArray[np.float64], taken: NDArray[np.float64]) -> float:
    """Share of a track that lies within a street's width of others."""
    if len(taken) == 0:
        return 0.0
    gaps_m = np.linalg.norm(track[:, None] - taken[None], axis=2).min(1)
    return float((gaps_m < 15.0).mean())


def _poses(
    route: NDArray[np.float64], start_m: float, speed_mps: float, time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    along_m = start_m + speed_mps * time_s + PULSE_M * np.sin(PULSE_RAD_PER_S * time_s)
    return follow(route, along_m)
