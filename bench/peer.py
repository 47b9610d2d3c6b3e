"""Steps of nerfstudio's nerfacto in torch mode, for `bench/train_step.py --peer`; runs in another environment.

Reads one JSON line with the shape, then one line for each step; writes a JSON line for each. Needs only torch
and nerfstudio 1.1.5.
"""

import contextlib
import json
import sys
import time
from typing import Any

import torch

STREET_M = 200.0
SPATIAL_SCALE = 0.05  # field units a metre, as the released code scales its cameras


def main() -> None:
    """Serve steps until the input ends."""
    shape = json.loads(sys.stdin.readline())
    torch.set_num_threads(shape["threads"])
    with contextlib.redirect_stdout(sys.stderr):
        model = nerfacto(shape)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2, eps=1e-15)  # nerfacto's own
    print(json.dumps({"parameters": sum(parameter.numel() for parameter in model.parameters())}), flush=True)
    for number, _ in enumerate(sys.stdin):
        wall, processor = time.perf_counter(), time.process_time()
        step(model, optimiser, shape["batch_rays"], number)
        seconds = {"wall": time.perf_counter() - wall, "processor": time.process_time() - processor}
        print(json.dumps(seconds), flush=True)


def nerfacto(shape: dict[str, Any]) -> torch.nn.Module:
    """The model with the grids, networks and samples of the shape."""
    import torchmetrics.image.lpip as lpips
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    # A metric of evaluation, which would download a network.
    lpips.LearnedPerceptualImagePatchSimilarity = lambda **_: torch.nn.Identity()  # type: ignore[misc, assignment]
    grid = shape["grid"]
    config = NerfactoModelConfig(
        near_plane=shape["near_m"] * SPATIAL_SCALE,
        far_plane=shape["far_m"] * SPATIAL_SCALE,
        hidden_dim=shape["hidden_width"],
        hidden_dim_color=shape["hidden_width"],
        num_levels=grid["levels"],
        base_res=grid["min_resolution"],
        max_res=grid["max_resolution"],
        log2_hashmap_size=grid["log2_rows"],
        features_per_level=grid["features_per_level"],
        num_proposal_samples_per_ray=tuple(shape["proposal_samples"]),
        num_nerf_samples_per_ray=shape["field_samples"],
        num_proposal_iterations=len(shape["proposals"]),
        proposal_net_args_list=[_proposal(proposal, shape["proposal_width"]) for proposal in shape["proposals"]],
        proposal_warmup=1,  # at once every fifth step, as after the warm-up
        appearance_embed_dim=shape["embedding"],
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        implementation="torch",
    )
    half = STREET_M / 2 * SPATIAL_SCALE
    box = SceneBox(torch.tensor([[-half, -half, -half], [half, half, half]]))
    model = config.setup(scene_box=box, num_train_data=shape["frames"], metadata={})
    return model.train()


def step(model: Any, optimiser: torch.optim.Optimizer, count: int, number: int) -> None:
    """One step on random rays."""
    from nerfstudio.cameras.rays import RayBundle

    generator = torch.Generator().manual_seed(number)
    origins = torch.zeros(count, 3)
    origins[:, 0] = (torch.rand(count, generator=generator) - 0.5) * STREET_M * SPATIAL_SCALE
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator) * torch.tensor([1, 1, 0.2]))
    cameras = torch.randint(model.num_train_data, (count, 1), generator=generator)
    bundle = RayBundle(origins, directions, torch.ones(count, 1), camera_indices=cameras)
    batch = {"image": torch.rand(count, 3, generator=generator)}
    outputs = model(bundle)
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    torch.stack(list(losses.values())).sum().backward()
    optimiser.step()
    optimiser.zero_grad()
    model.proposal_sampler.step_cb(number + 10)  # below 10 the proposals learn in every step


def _proposal(grid: dict[str, int], width: int) -> dict[str, Any]:
    return {
        "hidden_dim": width,
        "num_levels": grid["levels"],
        "base_res": grid["min_resolution"],
        "max_res": grid["max_resolution"],
        "log2_hashmap_size": grid["log2_rows"],
        "features_per_level": grid["features_per_level"],
        "use_linear": False,
    }


if __name__ == "__main__":
    main()
