"""Light after sunset: street lamps and head lights, as small arrays that the kernels look up."""

# ruff: noqa: PLR0913, PLR0917 - kernels take plain numbers

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from presight_core.synthetic.actors import KINDS, Actor, foot_of
from presight_core.synthetic.jit import inner

REACH_M = 26.0  # street lamps light nothing beyond this distance on the ground: the next one stands 14 m away
CELL_M = 8.0
NEAR_COUNT = 8  # lamps that a place can see; junctions have about so many
BEAM_REACH_M = 70.0
BEAM_COUNT = 6  # other vehicles whose head lights light the street
LIGHT_M = 0.65  # height of head lights
EGO_FRONT_M = 3.7  # from the ego's origin, its rear axle, to the head lights


class Lamps(NamedTuple):
    """The light heads of a city's street lamps, and the nearest of them for every cell of the map."""

    heads: NDArray[np.float64]  # (L, 3) world metres
    low: NDArray[np.float64]  # (2,) corner of the first cell
    nearest: NDArray[np.int32]  # (N, M, NEAR_COUNT) indices of heads, nearest first, then -1


def lamp_grid(heads: NDArray[np.float64]) -> Lamps:
    """The lookup of light heads (L, 3)."""
    if len(heads) == 0:
        return Lamps(np.zeros((0, 3)), np.zeros(2), np.full((1, 1, NEAR_COUNT), -1, np.int32))
    low = heads[:, :2].min(0) - REACH_M
    counts = np.ceil((heads[:, :2].max(0) + REACH_M - low) / CELL_M).astype(int)
    centres = low + (np.stack(np.indices(counts), -1) + 0.5) * CELL_M
    within_m = REACH_M + 0.71 * CELL_M  # 0.71: half a cell's diagonal
    _, found = KDTree(heads[:, :2]).query(centres, NEAR_COUNT, distance_upper_bound=within_m)
    nearest = np.where(found < len(heads), found, -1).astype(np.int32)
    return Lamps(np.ascontiguousarray(heads), low, nearest)


def driving(actors: Sequence[Actor]) -> list[Actor]:
    """The vehicles with their lights on: those with an engine that are not parked."""
    vehicles = [actor for actor in actors if KINDS[actor.kind].category.startswith("vehicle")]
    return [actor for actor in vehicles if actor.motion != "parked" and actor.kind != "cyclist"]


def head_light_beams(vehicles: Sequence[Actor], ego: NDArray[np.float64] | None, centre: ArrayLike) -> NDArray:
    """Beams (B, 5) of the ego car (`ego`: world_from_ego) and of the vehicles next to a place (2,).

    A beam is its source x, y, z and the heading x, y of its axis, world metres.
    """
    x, y = np.asarray(centre)[:2]
    nearest = sorted(vehicles, key=lambda actor: np.hypot(actor.x_m - x, actor.y_m - y))[:BEAM_COUNT]
    beams = []
    if ego is not None:
        beams.append([*(ego @ [EGO_FRONT_M, 0, LIGHT_M, 1])[:3], *ego[:2, 0]])
    for actor in nearest:
        heading = np.array([np.cos(actor.yaw_rad), np.sin(actor.yaw_rad)])
        foot = foot_of(actor)
        ahead_m = KINDS[actor.kind].length_m / 2 + 0.1  # 0.1: out of its own bonnet
        beams.append([*(foot[:2] + ahead_m * heading), foot[2] + LIGHT_M, *heading])
    return np.array(beams, np.float64).reshape(-1, 5)


@inner
def street_light(lamps, x, y, z, nx, ny, nz):
    """Light of the street lamps on a surface point; straight below a lamp it is 1."""
    column, row = int(np.floor((x - lamps.low[0]) / CELL_M)), int(np.floor((y - lamps.low[1]) / CELL_M))
    if column < 0 or row < 0 or column >= lamps.nearest.shape[0] or row >= lamps.nearest.shape[1]:
        return 0.0
    total = 0.0
    for k in range(NEAR_COUNT):
        lamp = lamps.nearest[column, row, k]
        if lamp < 0:
            break
        dx, dy, dz = lamps.heads[lamp, 0] - x, lamps.heads[lamp, 1] - y, lamps.heads[lamp, 2] - z
        flat = dx * dx + dy * dy
        if dz <= 0 or flat > REACH_M * REACH_M:  # nothing goes up
            continue
        squared = flat + dz * dz + 4  # 4: leaves beside a lamp would burn out
        distance = np.sqrt(squared)
        facing = (nx * dx + ny * dy + nz * dz) / distance
        if facing <= 0:
            continue
        down = dz / distance
        cone = min(max((down - 0.10) / 0.55, 0.0), 1.0)  # full within 50 degrees of straight down, none at 84
        edge = 1 - flat / (REACH_M * REACH_M)
        total += 55.8 * facing * cone * cone * (3 - 2 * cone) * edge * edge / squared  # 55.8: 1 from 7.2 m
    return total


@inner
def beam_light(beams, x, y, z, nx, ny, nz):
    """Light of low-beam head lights on a surface point; about 1 on a wall at 7 m."""
    total = 0.0
    for k in range(len(beams)):
        dx, dy, dz = x - beams[k, 0], y - beams[k, 1], z - beams[k, 2]
        ahead = dx * beams[k, 3] + dy * beams[k, 4]
        squared = dx * dx + dy * dy + dz * dz
        if ahead < 0.4 or squared > BEAM_REACH_M * BEAM_REACH_M:
            continue
        aside = (dy * beams[k, 3] - dx * beams[k, 4]) / ahead
        up = dz / ahead + 0.02  # beams point down by about a degree
        spread = 0.20 if up < 0 else 0.07  # a sharp cut above, so that nobody is dazzled
        beam = np.exp(-5 * aside * aside - (up / spread) ** 2) + 0.08 * np.exp(-2 * aside * aside - up * up)
        facing = max(-(nx * dx + ny * dy + nz * dz) / np.sqrt(squared), 0.0)
        edge = 1 - squared / (BEAM_REACH_M * BEAM_REACH_M)
        # A fifth at any angle: rough asphalt and paint send light back to where it comes from.
        total += 80 * beam * (0.2 + 0.8 * facing) * edge / (squared + 30)
    return total
