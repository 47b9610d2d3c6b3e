"""The `presight-perception` command."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from presight_core.errors import PresightError

app = typer.Typer(
    help="Use PreSight's priors in online perception.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def options() -> None:
    """Use PreSight's priors in online perception."""


@app.command()
def experiment(  # noqa: PLR0913, PLR0917 - a command's options
    name: Annotated[
        str,
        typer.Argument(
            help="headline, maps, occupancy, priors, features, drives, noise or prior-only.", show_default=False
        ),
    ],
    data: Annotated[Path, typer.Option(help="Root of a data set in nuScenes format.", show_default=False)],
    store: Annotated[
        str, typer.Option(help="Folder or URL of the priors, WORKSPACE/store of presight.", show_default=False)
    ],
    colours_store: Annotated[
        str, typer.Option(help="The same for priors with the features `colours`, a row of `features`.")
    ] = "",
    version: Annotated[str, typer.Option(help="Folder of the data set's tables.")] = "v1.0-trainval",
    out: Annotated[Path, typer.Option(help="Folder of runs and results; an interrupted experiment goes on.")] = Path(
        "experiments"
    ),
    model: Annotated[str, typer.Option(help="raster, stream, maptr, bevdet-occ or fb-occ; the table's own.")] = "",
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each row.")] = 3,
    steps: Annotated[int, typer.Option(min=1, help="Of each training; line decoders take five times as many.")] = 600,
    test_stride: Annotated[int, typer.Option(min=1, help="Try every so many-th keyframe of the test drives.")] = 2,
    parallel: Annotated[int, typer.Option(min=1, help="Runs side by side, each on one processor.")] = 2,
) -> None:
    """Train and try models with and without prior, and write a table with pictures."""
    from presight_perception.experiment.command import ExperimentOrder, run_experiment

    order = ExperimentOrder(
        name, data, version, store, colours_store or None, out, model or None, seeds, steps, test_stride, parallel
    )
    print(f"look at {run_experiment(order)}")


def main() -> None:
    """Run the command line; a mistake of the user's is one line on standard error and exit code 2."""
    try:
        app()
    except PresightError as error:
        print(f"presight-perception: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
