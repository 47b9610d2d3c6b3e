"""Fusion modules beyond their golden values: sizes, batches, compilation, export."""

import io
import warnings

import numpy as np
import onnxruntime
import pytest
import torch

from presight_core.errors import InputError
from presight_perception.fusion import Fusion2DSettings, Fusion3DSettings, PriorFusion2D, PriorFusion3D
from presight_perception.voxelise import VoxelGrid

GRID = VoxelGrid((-4.0, -2.0, -2.0), (4.0, 2.0, 2.0), (0.5, 0.5, 0.5))  # 16 x 8 x 8
SMALL_2D = Fusion2DSettings(GRID, 6, 8, 12)
SMALL_3D = Fusion3DSettings(GRID, 6, 8, 16, 5, 4)
BEVS = {"2d": (12, 4, 8), "3d": (5, 8, 16, 4)}


def small(kind: str) -> PriorFusion2D | PriorFusion3D:
    torch.manual_seed(0)
    module = PriorFusion2D(SMALL_2D) if kind == "2d" else PriorFusion3D(SMALL_3D)
    return module.eval()


def inputs(kind: str, voxel_count: int = 40, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(voxel_count)
    x, y, z = GRID.shape
    rows = torch.randperm(batch * x * y * z, generator=random)[:voxel_count]
    coordinates = torch.stack([rows // (x * y * z), rows // (y * z) % x, rows // z % y, rows % z], 1)
    bev = torch.randn(batch, *BEVS[kind], generator=random)
    return bev, torch.randn(voxel_count, 6, generator=random), coordinates


@pytest.mark.parametrize(("module", "count"), [(PriorFusion2D, 735_488), (PriorFusion3D, 932_928)])
def test_the_defaults_have_the_released_number_of_parameters(module, count):
    assert sum(parameter.numel() for parameter in module().parameters()) == count


@pytest.mark.parametrize("kind", BEVS)
def test_a_batch_is_fused_like_its_samples_alone(kind):
    module, (bev, voxels, coordinates) = small(kind), inputs(kind)
    together = module(bev, voxels, coordinates)
    for sample in range(2):
        own = coordinates[:, 0] == sample
        alone = module(bev[sample : sample + 1], voxels[own], coordinates[own] * torch.tensor([0, 1, 1, 1]))
        torch.testing.assert_close(together[sample], alone[0])


@pytest.mark.parametrize("kind", BEVS)
def test_the_order_of_voxels_does_not_matter(kind):
    module, (bev, voxels, coordinates) = small(kind), inputs(kind)
    torch.testing.assert_close(module(bev, voxels, coordinates), module(bev, voxels.flip(0), coordinates.flip(0)))


@pytest.mark.parametrize("kind", BEVS)
def test_a_voxel_is_fused_where_it_lies(kind):
    """Back right: least x and y, hence the first row and column."""
    module, (bev, voxels, _) = small(kind), inputs(kind, 1)
    none = module(bev, voxels[:0], torch.zeros(0, 4, dtype=torch.long))
    one = module(bev, voxels, torch.tensor([[0, 0, 0, 1]]))
    change = (one - none).abs()[0].flatten(3).sum(3).sum(0) if kind == "3d" else (one - none).abs()[0].sum(0)
    assert change[:2, :3].sum() > 0
    assert change[4:, 8:].sum() == 0


@pytest.mark.parametrize("kind", BEVS)
def test_every_weight_learns(kind):
    module, given = small(kind), inputs(kind)
    module(*given).square().mean().backward()
    assert [name for name, weight in module.named_parameters() if weight.grad is None or not weight.grad.any()] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", BEVS)
def test_compilation_meets_no_graph_break(kind):
    module = small(kind)
    compiled = torch.compile(module, backend="eager", fullgraph=True, dynamic=True)
    for count in (40, 25):
        torch.testing.assert_close(compiled(*inputs(kind, count)), module(*inputs(kind, count)))


@pytest.mark.parametrize("kind", BEVS)
def test_the_exported_network_agrees_at_any_number_of_voxels(kind):
    module, content = small(kind), io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the newer exporter needs onnxscript
        torch.onnx.export(
            module,
            inputs(kind),
            content,
            input_names=["bev", "voxels", "coordinates"],
            dynamic_axes={"voxels": {0: "count"}, "coordinates": {0: "count"}},
            opset_version=17,
            dynamo=False,
        )
    session = onnxruntime.InferenceSession(content.getvalue(), providers=["CPUExecutionProvider"])
    for count in (40, 25, 0):
        given = inputs(kind, count)
        named = dict(zip(("bev", "voxels", "coordinates"), (part.numpy() for part in given), strict=True))
        (found,) = session.run(None, named)
        np.testing.assert_allclose(found, module(*given).detach(), atol=1e-5)


def test_heights_that_do_not_divide_the_channels_are_an_error():
    with pytest.raises(InputError, match="flat_channels 10 cannot be cut into 4 heights"):
        PriorFusion3D(Fusion3DSettings(GRID, 6, 8, 10, 5, 4))
