"""A whole training step through the Triton kernels, under their interpreter, watched for what no graph can record.

`TRITON_INTERPRET=1 python -m tests.stages.step_interpreted FOLDER` prints the operations that would wait for a card,
and by how much the losses differ from those of the processor's own kernels, as JSON.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.stages.test_card_training import card_run

SMALL = (
    "training.ground.weight=0.1",
    "training.stereo.weight=0.1",
    "training.bfloat16=false",
    "training.batch_rays=8",
    "sampling.proposal_samples=[4, 3]",
    "sampling.field_samples=3",
)
# Shapes that depend on values, values that the host reads, and tensors that the host fills.
WAITING = (
    "_local_scalar_dense", "nonzero", "masked_select", "bincount", "unique", "repeat_interleave", "lift_fresh",
)  # fmt: skip


class Watch(TorchDispatchMode):
    """Collects the names of operations during which a card would wait for the host, or the host for the card."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()
        to_list = torch.Tensor.tolist
        torch.Tensor.tolist = lambda tensor: self.found.add("tolist") or to_list(tensor)  # no operation of its own

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func)
        masks = name.startswith("aten.index") and "select" not in name and self._has_mask(args[1])
        if masks or any(part in name for part in WAITING):
            self.found.add(name)
        return func(*args, **(kwargs or {}))

    @staticmethod
    def _has_mask(indices: Any) -> bool:
        listed = indices if isinstance(indices, list | tuple) else [indices]
        return any(isinstance(index, torch.Tensor) and index.dtype == torch.bool for index in listed)


def watched_step(scratch: Path) -> tuple[set[str], dict[str, float]]:
    """The waiting operations of a step, and its losses."""
    run = card_run(scratch, *SMALL)
    run.advance(0)  # the optimiser makes its state, and the pool is filled
    with Watch() as watch:
        losses = run._body(True)
    run.close()
    return watch.found, {name: float(loss) for name, loss in losses.items()}


if __name__ == "__main__":
    found, losses = watched_step(Path(sys.argv[1]))
    print(json.dumps({"interpreted": os.environ.get("TRITON_INTERPRET"), "waiting": sorted(found), "losses": losses}))
