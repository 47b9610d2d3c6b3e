import numpy as np
import pytest
import torch

from presight_core.config import GridSettings
from presight_core.field.hash_encode import GridLayout, torch_reference
from presight_core.field.hash_encode.layout import level_resolutions
from tests.golden.__main__ import main
from tests.golden.adapters import ADAPTERS, adapter_of
from tests.golden.runner import checks_of, golden_files


def test_every_case_is_within_tolerance(shared_data):
    files = golden_files(shared_data / "golden")
    assert {adapter_of(file.stem) for file in files} == set(ADAPTERS.values())
    missed = [(file.stem, check) for file in files for check in checks_of(file) if not check.passed]
    assert missed == []


def some_rows(golden: dict, count: int, seed: int) -> dict:
    """The arrays of `count` rays, in another order."""
    chosen = np.random.default_rng(seed).permutation(count)[: count * 2 // 3]
    return {
        name: values[..., chosen] if name == "threshold_unambiguous" else values[chosen]
        for name, values in golden.items()
    }


@pytest.mark.parametrize("case", ["pdf_sampling", "render_weights", "spherical_harmonics"])
def test_other_rays_in_another_order_are_understood(shared_data, tmp_path, case):
    with np.load(shared_data / "golden" / "nerf" / f"{case}.npz") as opened:
        golden = dict(opened)
    count = len(next(iter(golden.values())))
    np.savez(tmp_path / f"{case}.npz", **some_rows(golden, count, seed=1))
    checks = checks_of(tmp_path / f"{case}.npz")
    assert checks
    assert [check for check in checks if not check.passed] == []


def test_a_hash_grid_of_another_size_is_understood(tmp_path):
    generator = torch.Generator().manual_seed(3)
    resolutions = level_resolutions(
        GridSettings(levels=5, features_per_level=2, min_resolution=8, max_resolution=300, log2_rows=9)
    )
    layout = GridLayout(resolutions, (512,) * 5, (True,) * 5, features=2, sub_field_count=1)
    points, table = torch.rand(70, 3, generator=generator), torch.randn(2560, 2, generator=generator)
    upstream = torch.randn(70, 10, generator=generator)
    where = (torch.tensor([0, 70]), table.requires_grad_(), layout.offsets(), layout.levels())
    output = torch_reference.encode(points.requires_grad_(), *where)
    output.backward(upstream)
    arrays = {
        "points": points, "hash_table": table, "output": output, "grad_output": upstream,
        "grad_points": points.grad, "grad_hash_table": table.grad,
    }  # fmt: skip
    numbers = {"num_levels": 5, "min_res": 8, "max_res": 300, "log2_hashmap_size": 9, "features_per_level": 2}
    file = tmp_path / "hash_encode_L5F2T9.npz"
    np.savez(
        file,
        on_lattice=np.zeros(70, np.bool_),
        scalings=np.array(resolutions, np.float32),
        **{name: tensor.detach().numpy() for name, tensor in arrays.items()},
        **{name: np.array(number) for name, number in numbers.items()},
    )
    assert [check for check in checks_of(file) if not check.passed] == []


def test_a_folder_without_golden_values_is_an_error(tmp_path, capsys):
    assert main(tmp_path) == 2
    assert "no golden values" in capsys.readouterr().err


def test_a_case_without_an_adapter_is_missed(tmp_path, capsys):
    np.savez(tmp_path / "unheard_of.npz", x=np.zeros(1))
    assert main(tmp_path) == 1
    assert "no adapter for unheard_of" in capsys.readouterr().out


def test_a_case_without_its_arrays_is_missed(tmp_path, capsys):
    np.savez(tmp_path / "spherical_harmonics.npz", directions=np.zeros((1, 3), np.float32))
    assert main(tmp_path) == 1
    assert "MISS" in capsys.readouterr().out


def test_a_missed_tolerance_is_an_error(shared_data, monkeypatch, capsys):
    from presight_core.field import losses

    monkeypatch.setattr(losses, "sky_loss", lambda accumulation, is_sky: accumulation.sum())
    assert main(shared_data / "golden" / "nerf") == 1
    assert "MISS  nerf/losses  sky" in capsys.readouterr().out
