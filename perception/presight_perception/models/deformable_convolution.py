"""Modulated deformable convolution in plain PyTorch (Deformable ConvNets v2)."""

import torch
from torch import Tensor, nn
from torch.nn import functional

TAPS = 9  # of a kernel of 3 x 3


class DeformableConvolution(nn.Module):
    """A 3 x 3 convolution without bias that learns where its taps look, and how much each counts."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(outputs, inputs, 3, 3))
        self.offset = nn.Conv2d(inputs, 3 * TAPS, 3, stride, padding=1)  # y and x of each tap, then their shares
        self.initialise()

    def initialise(self) -> None:
        """As a plain convolution whose taps count half, like the released layers."""
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")
        nn.init.zeros_(self.offset.weight)
        if self.offset.bias is not None:
            nn.init.zeros_(self.offset.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, outputs, h, w) of (B, inputs, H, W), padded by one zero."""
        learned = self.offset(features)
        moves, counts = learned[:, : 2 * TAPS].unflatten(1, (TAPS, 2)), learned[:, 2 * TAPS :].sigmoid()
        height, width = learned.shape[-2:]
        y, x = (moves[:, :, axis] + place for axis, place in enumerate(self._places(learned)))  # (B, taps, h, w)
        size = features.new_tensor([features.shape[3], features.shape[2]])
        grid = (2 * torch.stack([x, y], -1) + 1) / size - 1  # -1..1 over the image; a pixel's centre is at half
        sampled = functional.grid_sample(features, grid.flatten(1, 2), align_corners=False)
        sampled = sampled.view(*features.shape[:2], TAPS, height, width) * counts[:, None]
        return torch.einsum("bikhw,oik->bohw", sampled, self.weight.flatten(2))

    def _places(self, learned: Tensor) -> tuple[Tensor, Tensor]:
        """Rows and columns (taps, h, w), in pixels, at which a plain convolution's taps look."""
        height, width = learned.shape[-2:]
        tap = torch.arange(3, device=learned.device) - 1
        rows = torch.arange(height, device=learned.device) * self.stride
        columns = torch.arange(width, device=learned.device) * self.stride
        y = (tap[:, None, None, None] + rows[:, None]).expand(3, 3, height, width)
        x = (tap[:, None, None] + columns).expand(3, 3, height, width)
        return y.flatten(0, 1), x.flatten(0, 1)
