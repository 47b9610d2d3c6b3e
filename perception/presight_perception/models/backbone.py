"""Image features of several cameras: a ResNet with a feature pyramid, in plain PyTorch.

Layers are named as torchvision names them: ImageNet weights from there, or from timm, load from a local file.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from presight_core.errors import InputError, NotFoundError, SettingsError
from presight_perception.models.deformable_convolution import DeformableConvolution

BLOCK_COUNTS = {10: (1, 1, 1, 1), 18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}
IMAGE_MEAN, IMAGE_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's red, green and blue


@dataclass(frozen=True)
class ResNetSettings:
    """Which ResNet, and which of its four stages are returned; stage s has stride 2 ** (s + 1)."""

    depth: Literal[10, 18, 34, 50, 101] = 50
    width: int = 64  # channels of the stem; ImageNet's weights need 64
    stages: tuple[int, ...] = (2, 3, 4)
    frozen_stages: int = 0  # the stem and so many stages never learn; 0 freezes nothing, not even the stem
    norm_eval: bool = False  # batch norms keep the statistics that they were loaded with
    norm_learns: bool = True  # False: batch norms' scales and shifts are frozen too
    deformable_stages: tuple[int, ...] = ()  # whose 3 x 3 convolutions learn where to look; of bottlenecks only
    stride_first: bool = False  # a bottleneck's first convolution strides (Caffe) instead of its second (PyTorch)

    def __post_init__(self) -> None:
        if self.deformable_stages and self.depth < 50:
            raise SettingsError(
                f"ResNet-{self.depth} has no bottlenecks for deformable_stages {self.deformable_stages}; set none"
            )

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the returned stages."""
        expansion = 4 if self.depth >= 50 else 1
        return tuple(self.width * 2 ** (stage - 1) * expansion for stage in self.stages)


class ResNet(nn.Module):
    """The features (B, channels, H / stride, W / stride) of the chosen stages of normalised images (B, 3, H, W)."""

    def __init__(self, settings: ResNetSettings) -> None:
        super().__init__()
        self.settings = settings
        self.conv1 = nn.Conv2d(3, settings.width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(settings.width)
        inputs = settings.width
        for stage, count in enumerate(BLOCK_COUNTS[settings.depth][: max(settings.stages)], 1):
            blocks = []
            for number in range(count):
                blocks.append(_block(settings, inputs, stage, first=number == 0))
                inputs = blocks[-1].outputs
            self.add_module(f"layer{stage}", nn.Sequential(*blocks))
        self.apply(_initialise)
        norms = [] if settings.norm_learns else [part for part in self.modules() if isinstance(part, nn.BatchNorm2d)]
        for module in (*self._frozen(), *norms):
            module.requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        features = functional.max_pool2d(torch.relu(self.bn1(self.conv1(images))), 3, stride=2, padding=1)
        found = []
        for stage in range(1, max(self.settings.stages) + 1):
            features = self.get_submodule(f"layer{stage}")(features)
            if stage in self.settings.stages:
                found.append(features)
        return found

    def train(self, mode: bool = True) -> "ResNet":
        """As of any module, but frozen stages, and with `norm_eval` all batch norms, stay as they were loaded."""
        super().train(mode)
        for module in self.modules() if self.settings.norm_eval else self._frozen():
            if module is not self:
                module.train(False)
        return self

    def load_weights(self, file: Path) -> None:
        """Take the weights in a safetensors file; the classifier's are ignored.

        The project reads no pickles: turn a .pth file into safetensors first (see perception/README.md).
        Raises NotFoundError if the file is absent, InputError if it is not of this net.
        """
        if not file.is_file():
            raise NotFoundError(f"{file} does not exist; give a local file of torchvision's ResNet weights")
        weights = {name: value for name, value in _read(file).items() if not name.startswith("fc.")}
        own = self.state_dict()
        own_alone = ("num_batches_tracked", "offset.weight", "offset.bias")  # published weights may lack them
        lacking = {name for name in own.keys() - weights.keys() if not name.endswith(own_alone)}
        different = [name for name in own.keys() & weights.keys() if own[name].shape != weights[name].shape]
        wrong = sorted([*lacking, *different, *(weights.keys() - own.keys() - self._later_stages(weights))])
        if wrong:
            raise InputError(
                f"{file} lacks, or has in other shapes, {len(wrong)} arrays of this ResNet-{self.settings.depth}, "
                f"{wrong[0]!r} the first; give weights of the same depth and width"
            )
        self.load_state_dict({**own, **{name: weights[name] for name in own.keys() & weights.keys()}})

    def _later_stages(self, weights: dict[str, Tensor]) -> set[str]:
        """Weights of stages behind the last that is returned, which this net does not have."""
        later = tuple(f"layer{stage}." for stage in range(max(self.settings.stages) + 1, 5))
        return {name for name in weights if later and name.startswith(later)}

    def _frozen(self) -> list[nn.Module]:
        if not self.settings.frozen_stages:
            return []
        stages = range(1, min(self.settings.frozen_stages, max(self.settings.stages)) + 1)
        return [self.conv1, self.bn1, *(self.get_submodule(f"layer{stage}") for stage in stages)]


class Basic(nn.Module):
    """The block of ResNet-18 and -34."""

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.outputs = width
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(inputs, width, stride)

    def forward(self, features: Tensor) -> Tensor:
        inner = torch.relu(self.bn1(self.conv1(features)))
        return torch.relu(self.bn2(self.conv2(inner)) + self.downsample(features))


class Bottleneck(nn.Module):
    """The block of ResNet-50 and -101."""

    def __init__(self, settings: ResNetSettings, inputs: int, stage: int, stride: int) -> None:
        super().__init__()
        width = settings.width * 2 ** (stage - 1)
        self.outputs = 4 * width
        first, second = (stride, 1) if settings.stride_first else (1, stride)
        self.conv1 = nn.Conv2d(inputs, width, 1, first, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        if stage in settings.deformable_stages:
            self.conv2 = DeformableConvolution(width, width, second)
        else:
            self.conv2 = nn.Conv2d(width, width, 3, second, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, self.outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(self.outputs)
        self.downsample = _shortcut(inputs, self.outputs, stride)

    def forward(self, features: Tensor) -> Tensor:
        inner = torch.relu(self.bn1(self.conv1(features)))
        inner = torch.relu(self.bn2(self.conv2(inner)))
        return torch.relu(self.bn3(self.conv3(inner)) + self.downsample(features))


class FeaturePyramid(nn.Module):
    """FPN: features of all stages in `channels` channels, coarse ones added to finer ones.

    Returns the finest `output_count` levels, None being all.
    """

    def __init__(self, inputs: tuple[int, ...], channels: int, output_count: int | None = None) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(count, channels, 1) for count in inputs)
        outputs = len(inputs) if output_count is None else output_count
        self.output = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in range(outputs))
        self.apply(_initialise_pyramid)

    def forward(self, stages: list[Tensor]) -> list[Tensor]:
        levels = [layer(stage) for layer, stage in zip(self.lateral, stages, strict=True)]
        for finer in range(len(levels) - 2, -1, -1):
            levels[finer] = levels[finer] + functional.interpolate(levels[finer + 1], levels[finer].shape[-2:])
        return [layer(level) for layer, level in zip(self.output, levels, strict=False)]


@dataclass(frozen=True)
class ImageEncoderSettings:
    """A ResNet and its pyramid."""

    resnet: ResNetSettings = field(default_factory=ResNetSettings)
    channels: int = 256
    output_count: int | None = None  # levels returned, the finest first; None: all stages


class ImageEncoder(nn.Module):
    """Features of several cameras' images, RGB 0..1, normalised here as ImageNet's were."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, settings: ImageEncoderSettings) -> None:
        super().__init__()
        self.resnet = ResNet(settings.resnet)
        self.pyramid = FeaturePyramid(settings.resnet.channels, settings.channels, settings.output_count)
        self.register_buffer("mean", torch.tensor(IMAGE_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGE_DEVIATION).view(3, 1, 1), persistent=False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Levels (B, N, channels, H / stride, W / stride) of images (B, N, 3, H, W), fine to coarse.

        Sides that no stride divides are rounded up: pad images to multiples of 32 px to keep shares of the image.
        """
        flat = (images.flatten(0, 1) - self.mean) / self.deviation
        return [level.unflatten(0, images.shape[:2]) for level in self.pyramid(self.resnet(flat))]


def _block(settings: ResNetSettings, inputs: int, stage: int, first: bool) -> Basic | Bottleneck:
    stride = 2 if first and stage > 1 else 1
    if settings.depth < 50:
        return Basic(inputs, settings.width * 2 ** (stage - 1), stride)
    return Bottleneck(settings, inputs, stage, stride)


def _shortcut(inputs: int, outputs: int, stride: int) -> nn.Module:
    if inputs == outputs and stride == 1:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))


def _initialise(layer: nn.Module) -> None:
    if isinstance(layer, nn.Conv2d):
        nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(layer, DeformableConvolution):  # after its parts: `apply` goes from the inside out
        layer.initialise()


def _initialise_pyramid(layer: nn.Module) -> None:
    if isinstance(layer, nn.Conv2d):
        nn.init.xavier_uniform_(layer.weight)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)


def _read(file: Path) -> dict[str, Tensor]:
    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{file} is not a safetensors file ({error}); convert or download it again") from error
