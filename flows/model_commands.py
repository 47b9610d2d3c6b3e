"""`presight models`: network checkpoints as ONNX files with model cards."""

from pathlib import Path
from typing import Annotated

import typer

from presight_core.errors import SettingsError

models = typer.Typer(help="Turn network checkpoints into ONNX files with model cards.", no_args_is_help=True)


@models.command()
def export(
    family: Annotated[str, typer.Argument(help="segformer (label maps) or dino (features).", show_default=False)],
    checkpoint: Annotated[Path, typer.Option(help="Folder of a Hugging Face checkpoint.", show_default=False)],
    out: Annotated[Path, typer.Option(help="ONNX file to write; its card goes beside it.", show_default=False)],
    size: Annotated[str, typer.Option(metavar="HEIGHTxWIDTH", help="Pixels that images are resized to.")] = "576x1024",
    output: Annotated[str, typer.Option(help="Of DINO's last layer: keys (as the paper) or tokens.")] = "keys",
    licence: Annotated[str, typer.Option(help="Licence to note in the card.")] = "see the checkpoint's page",
) -> None:
    """Export a local checkpoint, checked against torch."""
    if family not in ("segformer", "dino") or output not in ("keys", "tokens"):
        raise SettingsError(f"{family} with {output}: export segformer or dino, and keys or tokens")
    from stages.model_export import ExportOptions, export_model

    card = export_model(family, checkpoint, out, ExportOptions(*_pixels(size), output, licence))
    print(f"{card.file}: {card.channels} channels every {card.stride} px of {size} px")
    setting = "segmentation_model" if card.kind == "segmentation" else "feature_model"
    print(f"next: presight build CITY --set features.{setting}={out.with_suffix('.toml')}")


def _pixels(size: str) -> tuple[int, int]:
    height, _, width = size.partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise SettingsError(f"--size {size}: write height and width in pixels, for example 576x1024")
    return int(height), int(width)
