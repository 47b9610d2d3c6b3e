import collections
import re

import pytest

from tests.core.without_card import compile_for_hopper, interpreted

pytest.importorskip("triton", minversion="3.9")
pytestmark = pytest.mark.slow

TOLERANCES = {
    "values, 4 features": 1e-6,
    "values, 1 features": 1e-6,
    "values, 3 features": 1e-6,
    "table gradient, 4 features": 1e-6,
    "table gradient, 1 features": 1e-6,
    "table gradient, 3 features": 1e-6,
    "point gradient, 4 features": 1e-5,
    "point gradient, 1 features": 1e-5,
    "point gradient, 3 features": 1e-5,
    "values, smaller blocks": 1e-6,
    "values, half copy": 1e-3,  # one step of float16
    "rows beyond the table": 0,
    "rows of no points": 0,
}


@pytest.fixture(scope="module")
def errors() -> dict[str, float]:
    return interpreted("tests.core.triton_interpreted", "hash")


@pytest.mark.parametrize("case", TOLERANCES)
def test_kernels_agree_with_plain_torch_under_the_interpreter(errors, case):
    assert errors[case] <= TOLERANCES[case]


def test_every_interpreted_case_has_a_tolerance(errors):
    assert set(errors) == set(TOLERANCES)


@pytest.fixture(scope="module")
def accesses(tmp_path_factory) -> dict[tuple[str, int], collections.Counter[str]]:
    """How often each kind of memory access occurs in the code for a card of compute capability 9.0."""
    from presight_core.field.hash_encode import triton_kernels

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.mktemp("triton")))
        return {
            (name, features): _accesses(getattr(triton_kernels, name), features)
            for name in ("_encode", "_table_gradient", "_point_gradient")
            for features in (4, 1)
        }


def _accesses(kernel, features: int) -> collections.Counter[str]:
    values = {"points", "table", "gradient", "output", "result"}
    types = dict.fromkeys(kernel.arg_names, "*i64") | dict.fromkeys(values, "*fp32") | {"point_count": "i32"}
    constants = {"sub_field_count": 16, "level_count": 8, "features": features, "row": features}
    compiled = compile_for_hopper(kernel, types, constants | {"block": 256, "level_block": 2})
    return collections.Counter(re.findall(r"\b(?:red|atom|ld|st)\.[\w.]+", compiled.asm["ptx"]))


def test_rows_of_four_are_read_by_one_access(accesses):
    assert accesses["_encode", 4]["ld.global.v4.b32"] >= 8  # one for each corner, at least
    assert accesses["_encode", 4]["st.global.v4.b32"] > 0


def test_rows_of_four_are_added_by_one_access(accesses):
    additions = {name: count for name, count in accesses["_table_gradient", 4].items() if name[:3] in {"red", "ato"}}
    assert set(additions) == {"red.global.gpu.relaxed.add.v4.f32"}


def test_single_features_are_added_without_waiting_for_the_old_value(accesses):
    additions = {name: count for name, count in accesses["_table_gradient", 1].items() if name[:3] in {"red", "ato"}}
    assert set(additions) == {"red.global.gpu.relaxed.add.f32"}


def test_no_kernel_spills_registers(accesses):
    spills = {key: [name for name in counter if ".local" in name] for key, counter in accesses.items()}
    assert not any(spills.values())
