"""A box around a vehicle: which blocks, columns and voxels of the city fall inside it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from presight_core import frames
from presight_core.errors import InputError
from presight_core.grid import Lattice

LEAST_UPRIGHT = 0.1  # cosine of the tilt; a vehicle on its side has no ground plane to look up columns on

Range = tuple[float, float]


@dataclass(frozen=True)
class Window:
    """The prior inside a box of the ego frame. Rows are voxels, ordered by tile, block and packed voxel."""

    points_ego: NDArray[np.float32]  # (N, 3) metres
    points_world: NDArray[np.float64]  # (N, 3) metres
    features: NDArray[np.uint8]  # (N, C) 255 = 1.0
    hits: NDArray[np.uint32]  # (N,) surface points averaged
    density: NDArray[np.float16]  # (N,) per metre
    rgb: NDArray[np.uint8]  # (N, 3)
    observed: NDArray[np.bool_]  # (X, Y) lattice columns that some ray saw; unknown is not empty
    observed_origin: tuple[int, int]  # lattice column of observed[0, 0]
    coverage: float  # share of the box's ground that is observed, 0..1
    tiles: tuple[str, ...]  # that hold blocks in the box
    missing_tiles: tuple[str, ...] = ()  # of the tiling, near the box, that the generation has no build of

    def __len__(self) -> int:
        return len(self.hits)


@dataclass(frozen=True)
class WindowBox:
    """The half-open box `x_m` x `y_m` x `z_m` of the ego frame, placed in the world."""

    world_from_ego: NDArray[np.float64]
    x_m: Range
    y_m: Range
    z_m: Range

    @staticmethod
    def at(world_from_ego: ArrayLike, x_m: Range, y_m: Range, z_m: Range) -> "WindowBox":
        """A checked box. Raises InputError for a pose that is not rigid, lies on its side, or an empty range."""
        pose = np.asarray(world_from_ego, np.float64)
        if pose.shape != (4, 4) or not frames.is_rigid(pose):
            raise InputError(f"world_from_ego is not a rigid 4 x 4 transform: {pose.tolist()}; pass a pose in metres")
        if pose[2, 2] < LEAST_UPRIGHT:
            raise InputError(f"world_from_ego is tilted, cosine {pose[2, 2]:.2f}; the ego z axis must point up")
        for name, (low, high) in {"x_m": x_m, "y_m": y_m, "z_m": z_m}.items():
            if not low < high:
                raise InputError(f"{name} = ({low}, {high}) is empty; give the lower end first")
        return WindowBox(pose, x_m, y_m, z_m)

    @cached_property
    def corners_world(self) -> NDArray[np.float64]:
        """The eight corners (8, 3), world metres."""
        corners_ego = np.stack(np.meshgrid(self.x_m, self.y_m, self.z_m), -1).reshape(8, 3)
        return frames.apply(self.world_from_ego, corners_ego)

    def block_range(self, lattice: Lattice) -> NDArray[np.int64]:
        """Least and greatest blocks (2, 2) of the rectangle around the box's shadow."""
        corners = self.corners_world
        return lattice.block_of(lattice.voxel_of(np.stack([corners.min(0), corners.max(0)]))).astype(np.int64)

    def blocks(self, lattice: Lattice) -> NDArray[np.int32]:
        """The blocks (N, 2) that may hold voxels of the box."""
        least, greatest = self.block_range(lattice)
        axes = [np.arange(low, high + 1) for low, high in zip(least, greatest, strict=True)]
        blocks = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2).astype(np.int32)
        return blocks[self._near(blocks, lattice)]

    def meets(self, blocks: NDArray[np.int32], lattice: Lattice) -> NDArray[np.bool_]:
        """Which blocks (N, 2) may hold voxels of the box; exact for a level vehicle.

        Two rectangles are apart if an edge direction of either separates them: the lattice's and the heading's.
        """
        least, greatest = self.block_range(lattice)
        near = np.all((blocks >= least) & (blocks <= greatest), -1)
        near[near] = self._near(blocks[near], lattice)
        return near

    def _near(self, blocks: NDArray[np.int32], lattice: Lattice) -> NDArray[np.bool_]:
        """Which blocks (N, 2) no line along or across the heading parts from the box."""
        forward = self.world_from_ego[:2, 0] / np.linalg.norm(self.world_from_ego[:2, 0])
        axes = np.array([[forward[0], -forward[1]], [forward[1], forward[0]]])
        reach = lattice.block_m / 2 * np.abs(axes).sum(0)  # of a block, along each axis
        corners = self.corners_world[:, :2] @ axes
        low, high = corners.min(0) - reach, corners.max(0) + reach
        centres = lattice.block_centre(blocks) @ axes
        return np.all((centres >= low) & (centres <= high), -1)

    def inside(self, points_world: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """World points (N, 3) in the ego frame, and which of them lie in the box."""
        rotation, position = self.world_from_ego[:3, :3], self.world_from_ego[:3, 3]
        points_ego = rotation.T @ (points_world.T - position[:, None])  # axes apart, which is how tiles give them
        inside = np.ones(len(points_world), np.bool_)
        for values, (low, high) in zip(points_ego, (self.x_m, self.y_m, self.z_m), strict=True):
            inside &= (values >= low) & (values < high)
        return points_ego.T, inside

    def ground(self, origin: NDArray[np.int64], shape: tuple[int, int], lattice: Lattice) -> NDArray[np.bool_]:
        """Which columns, `shape` of them from column `origin`, meet the ground in x_m and y_m, at their centres.

        The ground is the ego plane z = 0. On it, the ego coordinates are linear in the column's x and y.
        """
        up = self.world_from_ego[:3, 2]
        inside = np.ones(shape, np.bool_)
        for axis, (low, high) in zip(self.world_from_ego[:3, :2].T, (self.x_m, self.y_m), strict=True):
            slope = axis[:2] - axis[2] * up[:2] / up[2]
            parts = []
            for side in range(2):
                centres = (origin[side] + np.arange(shape[side]) + 0.5) * lattice.voxel_m + lattice.origin_m[side]
                parts.append(((centres - self.world_from_ego[side, 3]) * slope[side]).astype(np.float32))
            values = parts[0][:, None] + parts[1]
            inside &= (values >= low) & (values < high)
        return inside
