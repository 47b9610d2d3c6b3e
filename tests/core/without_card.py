"""Triton kernels where there is no card: interpreted, and compiled for one."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def interpreted(module: str, argument: object, interpret: bool = True) -> dict[str, Any]:
    """The JSON that a module of the tests prints in a process of its own, where kernels are interpreted."""
    environment = os.environ | {"TRITON_INTERPRET": str(int(interpret)), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", module, str(argument)]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def compile_for_hopper(kernel, types: dict[str, str], constants: dict[str, int], **options: int):
    """A kernel compiled for sm_90, every pointer at a multiple of 16 bytes as torch's allocator gives them."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource, compile

    names = kernel.arg_names
    signature = {name: "constexpr" if name in constants else types[name] for name in names}
    aligned = {(i,): [["tt.divisibility", 16]] for i, name in enumerate(names) if signature[name].startswith("*")}
    values = {(names.index(name),): value for name, value in constants.items()}
    source = ASTSource(fn=kernel, signature=signature, constexprs=values, attrs=aligned)
    options = {"num_warps": 4, "enable_fp_fusion": True, **options}
    return compile(source, target=GPUTarget("cuda", 90, 32), options=options)
