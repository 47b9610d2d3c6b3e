import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", minversion="3.9")

BENCH = Path(__file__).parents[2] / "bench"
SECTIONS = (
    "device", "checks", "recorded step against eager", "step, eager", "step, graph", "step, graph and half copies",
    "extraction", "encode", "networks", "kernels of an eager step",
)  # fmt: skip


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCH))
    import gpu

    return gpu


def test_every_section_is_tried_here(gpu):
    assert tuple(gpu.SECTIONS) == SECTIONS


@pytest.mark.slow
@pytest.mark.parametrize("section", SECTIONS)
def test_a_section_runs_without_a_card(gpu, section):
    result = gpu.SECTIONS[section](gpu.Bench("cpu", "tiny"))
    assert result
    assert json.loads(json.dumps(result)) == result


@pytest.mark.slow
def test_results_and_failures_are_written_as_json(tmp_path):
    file = tmp_path / "gpu.json"
    command = [sys.executable, BENCH / "gpu.py", "--device", "cpu", "--size", "tiny", "--out", file]
    run = subprocess.run([*command, "--section", "device"], check=True, capture_output=True, text=True)
    assert json.loads(file.read_text())["device"]["torch"] == torch.__version__
    assert "bfloat16_tflop_per_s" in run.stdout
    late = subprocess.run([*command, "--minutes", "0"], check=True, capture_output=True, text=True)
    assert late.stdout.count("the time was up") == len(SECTIONS)


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_the_command_says_what_to_do():
    run = subprocess.run([sys.executable, BENCH / "gpu.py"], check=False, capture_output=True, text=True)
    assert run.returncode == 2
    assert "TRITON_INTERPRET=1 python bench/gpu.py --device cpu --size tiny" in run.stdout
