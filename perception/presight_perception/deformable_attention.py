"""Multi-scale deformable attention in plain PyTorch (Deformable DETR, eq. 3)."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def deformable_attention(
    value: Tensor, shapes: Sequence[tuple[int, int]], locations: Tensor, weights: Tensor
) -> Tensor:
    """Weighted sums (B, Q, heads * D) of values sampled at each query's own places, in several images.

    value (B, S, heads, D): all pixels of all levels, one level after the other, rows first; shapes: (height, width)
    of each level; locations (B, Q, heads, levels, P, 2): x, y as shares of the image, zeros are sampled outside 0..1;
    weights (B, Q, heads, levels, P).
    """
    batch, _, heads, width = value.shape
    queries = locations.shape[1]
    grids = (2 * locations - 1).transpose(1, 2).flatten(0, 1)  # (B * heads, Q, levels, P, 2), -1..1 over the image
    weights = weights.transpose(1, 2).flatten(0, 1)
    total = value.new_zeros(batch * heads, width, queries)
    for level, pixels in enumerate(value.split([rows * columns for rows, columns in shapes], 1)):
        image = pixels.permute(0, 2, 3, 1).reshape(batch * heads, width, *shapes[level])
        sampled = functional.grid_sample(image, grids[:, :, level], align_corners=False)
        total = total + torch.einsum("bdqp,bqp->bdq", sampled, weights[:, :, level])
    return total.view(batch, heads * width, queries).transpose(1, 2)
