"""`presight features`: the shared feature space, and a look at what the feature stage made."""

from typing import Annotated

import typer

from flows.options import AsJson, City, Overrides

features = typer.Typer(help="Fit the shared feature space, and look at features.", no_args_is_help=True)


@features.command()
def fit(
    context: typer.Context,
    city: Annotated[list[str], typer.Argument(help="Cities whose drives give the sample.", show_default=False)],
    override: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Fit one feature space on the drives of all given cities and freeze it."""
    from flows.features import fit_cities

    fit_cities(context.obj, city, override or [], as_json)


@features.command()
def show(
    context: typer.Context,
    drive: Annotated[str, typer.Argument(help="Drive: its scene's name or its id.", show_default=False)],
    camera: Annotated[str, typer.Option(help="Camera channel.")] = "CAM_FRONT",
    index: Annotated[int, typer.Option(min=0, help="Which of the camera's images, in order of time.")] = 0,
    png: Annotated[bool, typer.Option("--png", help="Draw them, into the workspace's reports.")] = False,
    override: Overrides = None,
) -> None:
    """Show an image, its labels, what is masked, and its features."""
    from flows.features import View, show_frame

    show_frame(context.obj, View(drive, camera, index), png, override or [])


@features.command()
def report(
    context: typer.Context,
    city: City,
    override: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Tell of each drive what share is masked, what its features take on the disk, and which step was slowest."""
    from flows.features import report_city

    report_city(context.obj, city, override or [], as_json)
