"""3D convolutional parts of the occupancy models: a ResNet and two feature pyramids. Voxels are (B, C, Z, Y, X)."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class ResNet3DSettings:
    """Stages of a 3D ResNet of basic blocks; the defaults are BEVDet-Occ's encoder of two frames."""

    inputs: int = 64
    channels: tuple[int, ...] = (32, 64, 128)
    blocks: tuple[int, ...] = (1, 2, 4)
    strides: tuple[int, ...] = (1, 2, 2)
    form: Literal["bevdet", "fb"] = "bevdet"  # fb: a stem, shortcuts of 1 voxel only where shapes differ, biases


class ResNet3D(nn.Module):
    """The features of every stage, fine to coarse."""

    def __init__(self, settings: ResNet3DSettings) -> None:
        super().__init__()
        bias, inputs = settings.form == "fb", settings.inputs
        self.stem = nn.Identity()
        if settings.form == "fb":
            inputs = settings.channels[0]
            self.stem = convolution_3d(settings.inputs, inputs, 1)
        stages = []
        for channels, count, stride in zip(settings.channels, settings.blocks, settings.strides, strict=True):
            shortcut = _shortcut(inputs, channels, stride, settings.form)
            blocks = [BasicBlock3D(inputs, channels, stride, shortcut, bias)]
            blocks += [BasicBlock3D(channels, channels, 1, nn.Identity(), bias) for _ in range(count - 1)]
            stages.append(nn.Sequential(*blocks))
            inputs = channels
        self.stages = nn.ModuleList(stages)
        self.apply(_initialise)

    def forward(self, voxels: Tensor) -> list[Tensor]:
        features, found = self.stem(voxels), []
        for stage in self.stages:
            features = stage(features)
            found.append(features)
        return found


class BasicBlock3D(nn.Module):
    """Two convolutions of 3 x 3 x 3 voxels beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, shortcut: nn.Module, bias: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv3d(inputs, outputs, 3, stride, padding=1, bias=bias)
        self.bn1 = nn.BatchNorm3d(outputs)
        self.conv2 = nn.Conv3d(outputs, outputs, 3, padding=1, bias=bias)
        self.bn2 = nn.BatchNorm3d(outputs)
        self.shortcut = shortcut

    def forward(self, voxels: Tensor) -> Tensor:
        inner = torch.relu(self.bn1(self.conv1(voxels)))
        return torch.relu(self.bn2(self.conv2(inner)) + self.shortcut(voxels))


class LssPyramid3D(nn.Module):
    """BEVDet-Occ's neck: all stages brought to the finest one's size, side by side, then mixed."""

    def __init__(self, inputs: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.mix = convolution_3d(sum(inputs), outputs, 1)

    def forward(self, stages: list[Tensor]) -> Tensor:
        """Voxels (B, outputs, Z, Y, X) of the finest stage's size."""
        size = stages[0].shape[2:]
        coarser = [_resized(stage, size, align_corners=True) for stage in stages[1:]]  # aligned as released
        return self.mix(torch.cat([stages[0], *coarser], 1))


class FeaturePyramid3D(nn.Module):
    """FB-OCC's neck: coarse stages added to finer ones, all in as many channels."""

    def __init__(self, inputs: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(convolution_3d(count, outputs, 1) for count in inputs)
        self.output = nn.ModuleList(convolution_3d(outputs, outputs, 3) for _ in inputs)

    def forward(self, stages: list[Tensor]) -> list[Tensor]:
        """Levels of the stages' sizes, fine to coarse."""
        levels = [layer(stage) for layer, stage in zip(self.lateral, stages, strict=True)]
        for finer in range(len(levels) - 2, -1, -1):
            levels[finer] = levels[finer] + _resized(levels[finer + 1], levels[finer].shape[2:])
        return [layer(level) for layer, level in zip(self.output, levels, strict=True)]


class LevelMixHead(nn.Module):
    """FB-OCC's head: logits at twice the resolution, each voxel weighing the levels of the pyramid for itself."""

    def __init__(self, inputs: int, level_count: int, widths: tuple[int, int], class_count: int) -> None:
        """`widths` are the channels of the mixed levels, and of what the classes are told from."""
        super().__init__()
        mixed, hidden = widths
        self.doubled = nn.Sequential(
            nn.ConvTranspose3d(inputs, mixed, 2, stride=2, bias=False), nn.BatchNorm3d(mixed), nn.ReLU()
        )
        self.levels = nn.ModuleList(convolution_3d(inputs, mixed, 3) for _ in range(level_count))
        self.shares = nn.Sequential(convolution_3d(mixed, hidden, 1), nn.Conv3d(hidden, level_count + 1, 1, bias=False))
        self.classes = nn.Sequential(convolution_3d(mixed, hidden, 1), nn.Conv3d(hidden, class_count, 1, bias=False))

    def forward(self, levels: list[Tensor]) -> Tensor:
        """Logits (B, classes, 2 Z, 2 Y, 2 X) of levels, fine to coarse, whose finest is (B, inputs, Z, Y, X)."""
        finest = self.doubled(levels[0])
        shares = self.shares(finest).softmax(1)
        total = finest * shares[:, :1]
        for number, (layer, level) in enumerate(zip(self.levels, levels, strict=True), 1):
            total = total + _resized(layer(level), finest.shape[2:]) * shares[:, number : number + 1]
        return self.classes(total)


class SubvoxelHead(nn.Module):
    """BEVDet-Occ's head, two layers for each voxel by itself; may predict several classes a voxel, one a subvoxel."""

    def __init__(self, inputs: int, class_count: int, subdivision: int = 1) -> None:
        super().__init__()
        self.subdivision = subdivision
        self.final = nn.Sequential(nn.Conv3d(inputs, inputs, 3, padding=1), nn.ReLU())
        self.classes = nn.Sequential(
            nn.Linear(inputs, 2 * inputs), nn.Softplus(), nn.Linear(2 * inputs, class_count * subdivision**3)
        )

    def forward(self, voxels: Tensor) -> Tensor:
        """Logits (B, X, Y, Z, classes), X, Y and Z being `subdivision` times those of voxels (B, inputs, Z, Y, X)."""
        logits = self.classes(self.final(voxels).permute(0, 4, 3, 2, 1))
        if self.subdivision == 1:
            return logits
        split = logits.unflatten(4, (self.subdivision, self.subdivision, self.subdivision, -1))  # x, y, z, class
        return split.permute(0, 1, 4, 2, 5, 3, 6, 7).flatten(5, 6).flatten(3, 4).flatten(1, 2)


def convolution_3d(inputs: int, outputs: int, size: int) -> nn.Sequential:
    """A convolution that keeps the grid, a batch norm and a ReLU."""
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, size, padding=size // 2, bias=False), nn.BatchNorm3d(outputs), nn.ReLU()
    )


def _shortcut(inputs: int, outputs: int, stride: int, form: Literal["bevdet", "fb"]) -> nn.Module:
    if form == "bevdet":  # of 3 voxels, and where shapes agree too: as released
        return nn.Sequential(nn.Conv3d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm3d(outputs))
    if inputs == outputs and stride == 1:
        return nn.Identity()
    return nn.Sequential(nn.Conv3d(inputs, outputs, 1, stride), nn.BatchNorm3d(outputs))


def _resized(voxels: Tensor, size: torch.Size, align_corners: bool = False) -> Tensor:
    if voxels.shape[2:] == size:
        return voxels
    return functional.interpolate(voxels, size, mode="trilinear", align_corners=align_corners)


def _initialise(layer: nn.Module) -> None:
    if isinstance(layer, nn.Conv3d):
        nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
