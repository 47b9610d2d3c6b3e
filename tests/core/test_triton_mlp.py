import re

import pytest

from tests.core.without_card import compile_for_hopper, interpreted

pytest.importorskip("triton", minversion="3.9")
pytestmark = pytest.mark.slow

SHARED_BYTES = 227 * 1024  # of one block of threads on a card of compute capability 9.0
PAPER = {"proposal": (8, 64, 1), "trunk": (40, 64, 80), "colour": (47, 64, 64, 3), "semantics": (64, 64, 64, 64)}


def test_networks_agree_with_a_loop_of_linear_layers_under_the_interpreter():
    errors = interpreted("tests.core.triton_interpreted", "mlp")
    assert len(errors) == 8
    for case, error in errors.items():
        # float16 has 11 bits, and a hidden value near zero may be rounded to either side of it.
        assert error < (2e-2 if "float16" in case else 2e-6), case


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> dict[tuple[str, str], object]:
    """Both kernels for the paper's networks, in bfloat16."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.mktemp("triton")))
        return {(name, way): _compile(widths, way) for name, widths in PAPER.items() for way in ("there", "back")}


def _compile(widths: tuple[int, ...], way: str) -> object:
    import torch

    from presight_core.field import triton_mlp

    kernel = triton_mlp._forward if way == "there" else triton_mlp._backward
    shapes = list(zip(widths[1:], widths[:-1], strict=True))
    layers = [torch.empty(16, *size, device="meta") for out, inputs in shapes for size in ((out, inputs), (out,))]
    constants = triton_mlp._constants(layers, torch.empty(17, device="meta"))
    halves = {"inputs", "of_inputs", "output", "gradient", "weight_1", "weight_2", "weight_3"}
    types = dict.fromkeys(kernel.arg_names, "*fp32") | dict.fromkeys(halves, "*bf16") | {"segments": "*i64"}
    options = {"num_warps": triton_mlp.WARPS}
    if way == "back":
        constants["blocks"] = triton_mlp.BLOCKS_BACK
        options = {"num_warps": triton_mlp.WARPS_BACK, "num_stages": triton_mlp.STAGES_BACK}
    options["enable_fp_fusion"] = constants.pop("enable_fp_fusion")
    return compile_for_hopper(kernel, types, constants, **options)


def test_networks_fit_into_shared_memory(compiled):
    assert max(kernel.metadata.shared for kernel in compiled.values()) <= SHARED_BYTES


def test_networks_run_on_matrix_units(compiled):
    for kernel in compiled.values():
        assert re.search(r"mma\S*\.bf16", kernel.asm["ptx"])


def test_gradients_of_weights_are_added_four_at_a_time(compiled):
    for name in PAPER:
        assert "red.global.gpu.relaxed.add.v4.f32" in compiled[name, "back"].asm["ptx"]
