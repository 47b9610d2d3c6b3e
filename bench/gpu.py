"""Check the card's kernels, then time them: `python bench/gpu.py`, one command, under eight minutes on one H200.

Every section runs in a process of its own, so that one failure leaves the others whole; a section that the time
no longer suffices for is left out and said so. Prints a table, and writes everything as JSON to bench/out/gpu.json.
`--device cpu --size tiny` runs the same code on a processor (under TRITON_INTERPRET=1 through the same kernels),
where the times mean nothing.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gpu_kernels
import gpu_steps
import torch
from gpu_sizes import Bench, Result

SECTION_SECONDS = 150  # of one section at most

SECTIONS: dict[str, Callable[[Bench], Result]] = {
    "device": gpu_kernels.device_section,
    "checks": gpu_kernels.check_section,
    "recorded step against eager": gpu_steps.graph_section,
    "step, eager": lambda bench: gpu_steps.step_section(bench, replays=False, copies=False),
    "step, graph": lambda bench: gpu_steps.step_section(bench, replays=True, copies=False),
    "step, graph and half copies": lambda bench: gpu_steps.step_section(bench, replays=True, copies=True),
    "extraction": gpu_steps.extraction_section,
    "encode": gpu_kernels.encode_section,
    "networks": gpu_kernels.network_section,
    "kernels of an eager step": gpu_steps.profile_section,
}


def main() -> int:
    """Run all sections, or one; 1 if any failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", choices=("paper", "tiny"), default="paper")
    parser.add_argument("--minutes", type=float, default=7.5, help="no section starts after this")
    parser.add_argument("--section", choices=SECTIONS, action="append", help="this one only; may be repeated")
    parser.add_argument("--here", action="store_true", help="in this process: prints one section's JSON")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "out" / "gpu.json")
    options = parser.parse_args()
    if options.device.startswith("cuda") and not torch.cuda.is_available():
        print("no card: torch.cuda.is_available() is False. On a machine with one, install torch's CUDA build;")
        print("here, try `TRITON_INTERPRET=1 python bench/gpu.py --device cpu --size tiny`.")
        return 2
    if options.here:
        torch.manual_seed(0)
        print(json.dumps(SECTIONS[options.section[0]](Bench(options.device, options.size))))
        return 0
    results = run_sections(options)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    return int(any("failed" in result for result in results.values()))


def run_sections(options: argparse.Namespace) -> dict[str, Result]:
    """The result of every section, or why it has none; printed as they come."""
    started, results = time.monotonic(), {}
    for name in options.section or SECTIONS:
        left = options.minutes * 60 - (time.monotonic() - started)
        results[name] = _in_own_process(name, options, left) if left > 0 else {"left out": "the time was up"}
        print(f"\n{name}")
        for what, value in results[name].items():
            print(f"  {what:60} {f'{value:,.4g}' if isinstance(value, float) else value}", flush=True)
    return results


def _in_own_process(name: str, options: argparse.Namespace, left: float) -> Result:
    command = [
        sys.executable,
        __file__,
        "--here",
        "--section",
        name,
        "--device",
        options.device,
        "--size",
        options.size,
    ]
    try:
        run = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=min(left + 30, SECTION_SECONDS)
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"not done after {min(left + 30, SECTION_SECONDS):.0f} s"}
    if run.returncode:
        return {"failed": run.stderr.strip()[-2000:]}
    return json.loads(run.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
