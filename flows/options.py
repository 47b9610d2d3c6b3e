"""Arguments and options that several commands share."""

from typing import Annotated

import typer

City = Annotated[
    str, typer.Argument(help="City: the log location, for example singapore-onenorth.", show_default=False)
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting, for example training.steps=2000."),
]
Runner = Annotated[str, typer.Option(help="Who builds tiles: threads of this machine, or dask.")]
Cluster = Annotated[
    str, typer.Option(metavar="ADDRESS", envvar="PRESIGHT_CLUSTER", help="Scheduler of --runner dask, tcp://HOST:8786.")
]
