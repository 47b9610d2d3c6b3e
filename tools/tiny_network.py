"""The tiny network: one small U-Net that gives both logits and features, and its two ONNX files."""

from pathlib import Path

import torch
from shipped_model import write_onnx
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate, pixel_shuffle, relu

from presight_core.classes import CITYSCAPES

CLASS_COUNT = len(CITYSCAPES)
FEATURE_CHANNELS = 64  # as many as a prior keeps
LOGIT_STRIDE, FEATURE_STRIDE = 2, 8


class TinyNetwork(nn.Module):
    """Encoder to stride 32, decoder to stride 8 (the features), two more steps to stride 2 (the logits).

    The features are the bounded bottleneck that the logits are made from, and a linear classifier reads the
    classes off them during training: patches of one kind therefore lie together, which is what PCA and a
    neural field need of them. Poles, signs and riders need stride 2: at stride 4 the best label map of poles
    overlaps the truth by 0.59, at stride 2 by 0.74.
    """

    def __init__(self) -> None:
        super().__init__()
        self.to_stride_2 = _convolve(3, 16, 2)
        self.to_stride_4 = _convolve(16, 32, 2)
        self.to_stride_8 = nn.Sequential(_convolve(32, 48, 2), _Residual(48))
        self.to_stride_16 = nn.Sequential(_convolve(48, 64, 2), _Residual(64))
        self.to_stride_32 = nn.Sequential(_convolve(64, 96, 2), _Residual(96))
        self.from_stride_32 = _convolve(96, FEATURE_CHANNELS, size=1)
        self.from_stride_16 = _convolve(64, FEATURE_CHANNELS, size=1)
        self.from_stride_8 = _convolve(48, FEATURE_CHANNELS, size=1)
        self.from_stride_4 = nn.Conv2d(32, 32, 1)
        self.from_stride_2 = nn.Conv2d(16, 16, 1)
        self.refine_16 = _convolve(FEATURE_CHANNELS, FEATURE_CHANNELS)
        self.refine_8 = _convolve(FEATURE_CHANNELS, FEATURE_CHANNELS)
        self.to_features = nn.Conv2d(FEATURE_CHANNELS, FEATURE_CHANNELS, 1)
        self.from_features = nn.Conv2d(FEATURE_CHANNELS, 32, 1)
        self.refine_4 = _convolve(32, 32)
        # Both give the four cells of stride 2 within one of stride 4; the second spares the classes the way through
        # sixteen channels.
        self.to_quarters = nn.Conv2d(32, 4 * 16, 1)
        self.to_coarse_logits = nn.Conv2d(32, 4 * CLASS_COUNT, 1)
        self.refine_2 = _convolve(16, 16)
        self.to_logits = nn.Conv2d(16, CLASS_COUNT, 1)
        self.feature_classifier = nn.Conv2d(FEATURE_CHANNELS, CLASS_COUNT, 1)  # for training only

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (N, 19, H/2, W/2) and features (N, 64, H/8, W/8) in [-1, 1] of normalised images (N, 3, H, W)."""
        at_2 = self.to_stride_2(image)
        at_4 = self.to_stride_4(at_2)
        at_8 = self.to_stride_8(at_4)
        at_16 = self.to_stride_16(at_8)
        deep = self.from_stride_32(self.to_stride_32(at_16))
        deep = deep + adaptive_avg_pool2d(deep, 1)  # the whole picture: night or day, street or park
        deep = self.refine_16(self.from_stride_16(at_16) + _enlarged(deep, at_16))
        deep = self.refine_8(self.from_stride_8(at_8) + _enlarged(deep, at_8))
        features = torch.tanh(self.to_features(deep))
        fine = self.refine_4(relu(self.from_stride_4(at_4) + _enlarged(self.from_features(features), at_4)))
        finest = self.refine_2(relu(self.from_stride_2(at_2) + pixel_shuffle(self.to_quarters(fine), 2)))
        return self.to_logits(finest) + pixel_shuffle(self.to_coarse_logits(fine), 2), features


class _Residual(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.first = _convolve(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return relu(x + self.second(self.first(x)))


class _Segmentation(nn.Module):
    """Only the logits, so that the exported file holds one output."""

    def __init__(self, network: TinyNetwork):
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        return self.network(image)[0]


class _Features(_Segmentation):
    def forward(self, image: Tensor) -> Tensor:
        return self.network(image)[1]


def export(network: TinyNetwork, kind: str, file: Path) -> None:
    """Write one ONNX file, input `image` (N, 3, 224, 400), output `logits` or `features`; N is free.

    kind: "segmentation" or "features".
    """
    module = (_Segmentation if kind == "segmentation" else _Features)(network.eval())
    write_onnx(module, "logits" if kind == "segmentation" else "features", file)


def _convolve(inputs: int, outputs: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def _enlarged(x: Tensor, like: Tensor) -> Tensor:
    return interpolate(x, size=like.shape[-2:], mode="bilinear", align_corners=False)
