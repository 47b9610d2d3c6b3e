"""The image backbone: sizes, weights from files, frozen parts."""

import pytest
import torch
from safetensors.torch import save_file

from presight_core.errors import InputError, SettingsError
from presight_perception.models.backbone import ImageEncoder, ImageEncoderSettings, ResNet, ResNetSettings
from presight_perception.models.deformable_convolution import DeformableConvolution

TINY = ResNetSettings(depth=10, width=4)


@pytest.mark.parametrize(("depth", "count"), [(18, 11_689_512), (34, 21_797_672), (50, 25_557_032), (101, 44_549_160)])
def test_networks_have_the_published_number_of_parameters(depth, count):
    classifier = (512 if depth < 50 else 2048) * 1000 + 1000  # which the published number includes
    with torch.device("meta"):
        network = ResNet(ResNetSettings(depth))
    assert sum(weight.numel() for weight in network.parameters()) + classifier == count


@pytest.mark.parametrize("depth", [10, 50])
def test_levels_have_their_strides(depth):
    settings = ImageEncoderSettings(ResNetSettings(depth, width=4, stages=(2, 3, 4)), channels=6, output_count=2)
    levels = ImageEncoder(settings)(torch.rand(1, 2, 3, 64, 96))
    assert [tuple(level.shape) for level in levels] == [(1, 2, 6, 8, 12), (1, 2, 6, 4, 6)]


def test_weights_load_from_a_file_with_a_classifier(tmp_path):
    source, target = ResNet(TINY), ResNet(TINY)
    save_file({**source.state_dict(), "fc.weight": torch.zeros(2, 2)}, tmp_path / "weights.safetensors")
    target.load_weights(tmp_path / "weights.safetensors")
    assert all(torch.equal(value, target.state_dict()[name]) for name, value in source.state_dict().items())


def test_names_are_torchvisions():
    names = set(ResNet(ResNetSettings(50, width=4)).state_dict())
    assert {"conv1.weight", "bn1.running_mean", "layer1.0.downsample.1.bias", "layer4.2.conv3.weight"} <= names


def test_weights_of_another_depth_are_an_error(tmp_path):
    save_file(ResNet(ResNetSettings(18, width=4)).state_dict(), tmp_path / "weights.safetensors")
    with pytest.raises(InputError, match="of this ResNet-10"):
        ResNet(TINY).load_weights(tmp_path / "weights.safetensors")


def test_a_file_of_something_else_is_an_error(tmp_path):
    (tmp_path / "weights.safetensors").write_bytes(b"no")
    with pytest.raises(InputError, match="is not a safetensors file"):
        ResNet(TINY).load_weights(tmp_path / "weights.safetensors")


def test_norms_in_evaluation_keep_their_statistics():
    network = ResNet(ResNetSettings(10, width=4, norm_eval=True)).train()
    network(torch.rand(2, 3, 32, 32))
    assert not network.state_dict()["bn1.running_mean"].any()
    assert network.training


def test_frozen_stages_do_not_learn():
    network = ResNet(ResNetSettings(10, width=4, frozen_stages=1)).train()
    network(torch.rand(2, 3, 32, 32))[-1].sum().backward()
    learning = {name.split(".")[0] for name, weight in network.named_parameters() if weight.grad is not None}
    assert learning == {"layer2", "layer3", "layer4"}
    assert not network.state_dict()["bn1.running_mean"].any()


@pytest.mark.parametrize("stride", [1, 2])
def test_a_deformable_convolution_begins_as_half_a_plain_one(stride):
    layer, features = DeformableConvolution(3, 4, stride), torch.rand(2, 3, 5, 6)
    plain = torch.nn.functional.conv2d(features, layer.weight, stride=stride, padding=1)
    torch.testing.assert_close(layer(features), plain / 2)


def test_a_deformable_convolution_looks_where_its_offsets_say():
    layer, features = DeformableConvolution(3, 4, 1), torch.rand(1, 3, 5, 6)
    with torch.no_grad():
        assert layer.offset.bias is not None
        layer.offset.bias[1:18:2] = 1.0  # all taps one pixel to the right
        layer.offset.bias[18:] = 30.0  # all count fully
    plain = torch.nn.functional.conv2d(features.roll(-1, 3), layer.weight, padding=1)
    torch.testing.assert_close(layer(features)[..., 1:-2], plain[..., 1:-2])


def test_plain_weights_load_into_deformable_stages(tmp_path):
    plain = ResNet(ResNetSettings(50, width=4))
    save_file(plain.state_dict(), tmp_path / "weights.safetensors")
    network = ResNet(ResNetSettings(50, width=4, deformable_stages=(4,)))
    network.load_weights(tmp_path / "weights.safetensors")
    name = "layer4.0.conv2.weight"
    assert torch.equal(network.state_dict()[name], plain.state_dict()[name])
    assert not network.state_dict()["layer4.0.conv2.offset.weight"].any()


def test_deformable_stages_need_bottlenecks():
    with pytest.raises(SettingsError, match="ResNet-18 has no bottlenecks"):
        ResNetSettings(18, deformable_stages=(4,))
