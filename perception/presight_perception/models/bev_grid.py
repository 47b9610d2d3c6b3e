"""The bird's-eye-view grid around a vehicle: rows from the right (least y), columns from behind (least x)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from presight_perception.voxelise import VoxelGrid

PRIOR_VOXELS_M = (0.5, 0.5, 0.5)  # as released
PRIOR_HEIGHTS_M = (-3.0, 5.0)  # as released


@dataclass(frozen=True)
class BevGrid:
    """A rectangle with the vehicle in its middle, cut into cells."""

    length_m: float = 100.0  # along x, half of it behind
    width_m: float = 50.0  # along y
    rows: int = 50
    columns: int = 100

    @property
    def prior_grid(self) -> VoxelGrid:
        """The voxels of a prior over the same rectangle."""
        (low, high), x, y = PRIOR_HEIGHTS_M, self.length_m / 2, self.width_m / 2
        return VoxelGrid((-x, -y, low), (x, y, high), PRIOR_VOXELS_M)

    def pillars(self, heights_m: tuple[float, ...]) -> Tensor:
        """Points (rows, columns, heights, 3) above the cells' centres, ego metres."""
        x = (torch.arange(self.columns) + 0.5) * self.length_m / self.columns - self.length_m / 2
        y = (torch.arange(self.rows) + 0.5) * self.width_m / self.rows - self.width_m / 2
        y, x, z = torch.meshgrid(y, x, torch.tensor(heights_m), indexing="ij")
        return torch.stack([x, y, z], -1)

    def centres(self) -> Tensor:
        """Centres (rows, columns, 2) of the cells, x and y as shares of the grid."""
        return self.shares_from_metres(self.pillars((0.0,))[:, :, 0, :2])

    def shares_from_metres(self, points_ego: Tensor) -> Tensor:
        """x and y (..., 2) as shares of the grid: 0 behind and on the right, 1 in front and on the left."""
        return points_ego / points_ego.new_tensor([self.length_m, self.width_m]) + 0.5

    def metres_from_shares(self, shares: Tensor) -> Tensor:
        """The inverse."""
        return (shares - 0.5) * shares.new_tensor([self.length_m, self.width_m])
