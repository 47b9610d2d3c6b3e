"""Write the `colours` feature model: statistics of colour and edges around each patch, nothing learned.

    python tools/write_colour_model.py --out presight_core/models/colours

The tiny network's features know the classes of the embedded city. Priors of these do not: what they are worth to a
model is what any camera could tell.
"""

import argparse
from pathlib import Path

import torch
from shipped_model import write_card, write_onnx
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, pad

STRIDE = 8
WINDOWS_PX = (8, 24)  # the patch itself, and it with its neighbours
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
EDGES = (  # differences across a pixel along x, y and both diagonals
    ((0, 0, 0), (-1, 0, 1), (0, 0, 0)),
    ((0, -1, 0), (0, 0, 0), (0, 1, 0)),
    ((-1, 0, 0), (0, 0, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 0, 0), (1, 0, 0)),
)
CHANNELS = len(WINDOWS_PX) * (3 + 1 + len(EDGES))


class ColourStatistics(nn.Module):
    """For each window: mean colour, deviation of brightness, and mean strength of edges in four directions."""

    luma: Tensor
    edges: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("luma", torch.tensor(LUMA).view(1, 3, 1, 1))
        self.register_buffer("edges", torch.tensor(EDGES, dtype=torch.float32).unsqueeze(1))

    def forward(self, image: Tensor) -> Tensor:
        """Features (N, 16, H / 8, W / 8) of images (N, 3, H, W)."""
        bright = conv2d(image, self.luma)
        strength = conv2d(pad(bright, (1, 1, 1, 1), mode="replicate"), self.edges).abs()
        return torch.cat([_statistics(image, bright, strength, window) for window in WINDOWS_PX], 1)


def _statistics(image: Tensor, bright: Tensor, strength: Tensor, window: int) -> Tensor:
    def mean(values: Tensor) -> Tensor:
        return avg_pool2d(values, window, STRIDE, (window - STRIDE) // 2, count_include_pad=False)

    variance = mean(bright.square()) - mean(bright).square()
    return torch.cat([mean(image), variance.clamp_min(0).sqrt(), mean(strength)], 1)


def main() -> None:
    """Write the ONNX file and its card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for features.onnx and features.toml")
    file = parser.parse_args().out / "features.onnx"
    write_onnx(ColourStatistics(), "features", file)
    write_card(
        file,
        name="colours",
        kind="features",
        output="features",
        stride=STRIDE,
        channels=CHANNELS,
        source="tools/write_colour_model.py of PreSight",
        note="Mean colour, deviation of brightness and edges in four directions, of each patch and of it with its "
        "neighbours. Nothing is learned: a baseline for what features are worth, and no stand-in for DINO.",
    )


if __name__ == "__main__":
    main()
