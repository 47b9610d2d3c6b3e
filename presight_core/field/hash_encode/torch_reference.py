"""The hash encoding in plain torch: the oracle of the fast kernels."""

import torch
from torch import Tensor

PRIMES = (1, 2654435761, 805459861)  # Instant-NGP, equation 4
# Corner k lies one cell further along x if bit 0 of k is set, along y if bit 1, along z if bit 2.
CORNERS = tuple((k & 1, k >> 1 & 1, k >> 2) for k in range(8))


def encode(points: Tensor, segments: Tensor, table: Tensor, offsets: Tensor, levels: Tensor) -> Tensor:
    """Encoded points (N, levels * features); see `hash_encode`. Differentiable in points and table."""
    outputs = []
    for level in range(len(levels)):
        rows, fraction = _locate(points, segments, offsets, levels, level)
        outputs.append((table[rows] * _weights(fraction)[..., None]).sum(1))
    return torch.cat(outputs, -1)


def table_gradient(
    points: Tensor, segments: Tensor, gradient: Tensor, offsets: Tensor, levels: Tensor, row_count: int
) -> Tensor:
    """Gradient (row_count, features) of the table for the gradient (N, levels * features) of the output."""
    features = gradient.shape[1] // len(levels)
    result = gradient.new_zeros(row_count, features)
    for level in range(len(levels)):
        rows, fraction = _locate(points, segments, offsets, levels, level)
        upstream = gradient[:, level * features : (level + 1) * features]
        result.index_add_(0, rows.reshape(-1), (_weights(fraction)[..., None] * upstream[:, None]).flatten(0, 1))
    return result


def point_gradient(
    points: Tensor, segments: Tensor, table: Tensor, offsets: Tensor, levels: Tensor, gradient: Tensor
) -> Tensor:
    """Gradient (N, 3) of the points for the gradient (N, levels * features) of the output."""
    features = table.shape[1]
    result = torch.zeros_like(points)
    for level in range(len(levels)):
        rows, fraction = _locate(points, segments, offsets, levels, level)
        upstream = gradient[:, level * features : (level + 1) * features]
        along_corners = (table[rows] * upstream[:, None]).sum(-1)
        for axis in range(3):
            slope = _weights(fraction, sloped_axis=axis) * levels[level, 0]
            result[:, axis] += (along_corners * slope).sum(-1)
    return result


def _locate(points: Tensor, segments: Tensor, offsets: Tensor, levels: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Table rows (N, 8) of the corners around each point at one level, and the place (N, 3) in the cell."""
    resolution, row_count, hashed = levels[level].tolist()
    scaled = points * resolution
    cell = scaled.detach().floor()
    corners = cell.long()[:, None] + torch.tensor(CORNERS, device=points.device)
    if hashed:
        x, y, z = (corners * torch.tensor(PRIMES, device=points.device)).unbind(-1)
        rows = (x ^ y ^ z) & (row_count - 1)
    else:
        edge = resolution + 1
        x, y, z = corners.unbind(-1)
        rows = (x + y * edge + z * edge * edge).clamp(0, row_count - 1)
    sub_field = torch.repeat_interleave(segments.diff(), output_size=len(points))
    return rows + offsets[sub_field, level, None], scaled - cell


def _weights(fraction: Tensor, sloped_axis: int | None = None) -> Tensor:
    """Trilinear weights (N, 8), or their slopes along one axis."""
    weights = fraction.new_ones(len(fraction), 8)
    upper = torch.tensor(CORNERS, device=fraction.device, dtype=torch.bool)
    for axis in range(3):
        place = fraction[:, axis, None]
        if axis == sloped_axis:
            weights = weights * torch.where(upper[:, axis], 1.0, -1.0).to(fraction)
        else:
            weights = weights * torch.where(upper[:, axis], place, 1 - place)
    return weights
