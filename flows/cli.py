"""The `presight` command. Every import that costs time happens inside the command that needs it."""

import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from flows import schedule_commands, store_commands
from flows.feature_commands import features
from flows.model_commands import models
from flows.options import AsJson, City, Cluster, Overrides, Runner
from presight_core.errors import MissingDependencyError, PresightError, StoreError

app = typer.Typer(
    help="Turn the camera logs of past drives into a city's neural prior.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(features, name="features")
app.add_typer(models, name="models")
catalog_commands = typer.Typer(help="Look after the catalog.", no_args_is_help=True)
app.add_typer(catalog_commands, name="catalog")
drive_commands = typer.Typer(help="The drives of the cities.", no_args_is_help=True)
app.add_typer(drive_commands, name="drives")

Shown = Annotated[int | None, typer.Option("--generation", help="Generation to read; the newest if not given.")]


@app.callback()
def options(
    context: typer.Context,
    workspace: Annotated[
        Path, typer.Option(envvar="PRESIGHT_WORKSPACE", help="Folder of catalog, caches and store.")
    ] = Path("workspace"),
) -> None:
    """Turn the camera logs of past drives into a city's neural prior."""
    context.obj = workspace


@app.command()
def ingest(
    context: typer.Context,
    root: Annotated[Path, typer.Argument(help="Root of a data set in nuScenes format.", show_default=False)],
    version: Annotated[str, typer.Option(help="Folder of its tables, for example v1.0-trainval.")] = "v1.0-trainval",
    scene: Annotated[
        list[str] | None, typer.Option(help="Only scenes of this name or pattern, scene-00*; may be given again.")
    ] = None,
    tests: Annotated[
        bool, typer.Option(help="Take the test scenes of the paper's split, too; priors must not see them.")
    ] = True,
    nights: Annotated[bool, typer.Option(help="Take scenes that say night, too; the paper's priors do not.")] = True,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Ingest the good frames of drives that have bad ones.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check and index the drives of a data set. Ingesting the same content again changes nothing."""
    from flows.ingest import ingest_root
    from stages.scene_choice import SceneChoice

    choice = SceneChoice(tuple(scene or ()), tests, nights)
    ingest_root(context.obj, root, version, keep_going, as_json, choice)


@app.command()
def plan(context: typer.Context, city: City, override: Overrides = None, as_json: AsJson = False) -> None:
    """Show a city's tiles, which are stale and why, and what building them costs."""
    from flows.forecast import show_plan

    show_plan(context.obj, city, override or [], as_json)


Parallel = Annotated[
    int | None, typer.Option(min=1, help="Tiles at once here; as many as GPUs, or else cores, if not given.")
]
Wait = Annotated[bool, typer.Option("--wait", help="Wait while another run builds the city, rather than refuse.")]
Accept = Annotated[
    list[str] | None,
    typer.Option(metavar="TILE", help="Publish the tile (or all of a pattern) however it differs from its old build."),
]


@app.command()
def build(
    context: typer.Context,
    city: City,
    override: Overrides = None,
    parallel: Parallel = None,
    runner: Runner = "threads",
    cluster: Cluster = "",
    wait: Wait = False,
    accept: Accept = None,
    as_json: AsJson = False,
) -> None:
    """Build and publish what is stale of a city, from nothing: features, training, extraction, validation."""
    from flows.build import Request, build_city
    from flows.machines import Machines

    machines = Machines(runner, cluster, parallel)
    build_city(context.obj, Request(city, override or [], machines, wait, accept or [], warm=False, as_json=as_json))


@app.command()
def update(
    context: typer.Context,
    city: City,
    override: Overrides = None,
    parallel: Parallel = None,
    runner: Runner = "threads",
    cluster: Cluster = "",
    wait: Wait = False,
    accept: Accept = None,
    as_json: AsJson = False,
) -> None:
    """As build, but a tile that only got new drives goes on from the field that it has, which takes fewer steps."""
    from flows.build import Request, build_city
    from flows.machines import Machines

    machines = Machines(runner, cluster, parallel)
    build_city(context.obj, Request(city, override or [], machines, wait, accept or [], warm=True, as_json=as_json))


@drive_commands.command("list")
def list_drives(
    context: typer.Context,
    city: Annotated[str | None, typer.Argument(help="City; all cities if not given.")] = None,
    as_json: AsJson = False,
) -> None:
    """List drives with their part of the split, also those that were removed."""
    from flows.drives import show_drives

    show_drives(context.obj, city, as_json)


@drive_commands.command("remove")
def remove_drive(
    context: typer.Context,
    drive: Annotated[str, typer.Argument(help="Name or id of a drive.", show_default=False)],
    wait: Annotated[bool, typer.Option("--wait", help="Wait while a run builds the city, rather than refuse.")] = False,
    as_json: AsJson = False,
) -> None:
    """Take a drive out of its city: the next generation does not contain it. Its data are left alone."""
    from flows.drives import show_removal

    show_removal(context.obj, drive, wait, as_json)


@catalog_commands.command("rebuild")
def rebuild_catalog(context: typer.Context, as_json: AsJson = False) -> None:
    """Make a lost catalog again, from the store and the index of drives."""
    from flows.reconcile import rebuild

    rebuild(context.obj, as_json)


@app.command()
def reconcile(
    context: typer.Context,
    city: Annotated[str | None, typer.Argument(help="City; all cities if not given.")] = None,
    as_json: AsJson = False,
) -> None:
    """Find runs that died, and end what they left as running in the catalog."""
    from flows.reconcile import show_reconciled

    show_reconciled(context.obj, city, as_json)


@app.command()
def status(
    context: typer.Context,
    city: Annotated[str | None, typer.Argument(help="City; all cities if not given.")] = None,
    tile: Annotated[
        str | None, typer.Option("--tile", help="Only this tile of the city, with all its metrics.")
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Show it every second until nothing runs.")] = False,
    exit_code: Annotated[
        bool,
        typer.Option("--exit-code", help="End with 6 if a tile failed, 7 while some are built, 8 if some are stale."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the state of every tile, as the catalog has it."""
    from flows.status import Request, show_status

    sys.exit(show_status(context.obj, Request(city, tile, watch, exit_code, as_json)))


@app.command()
def query(
    context: typer.Context,
    city: City,
    at: Annotated[
        str, typer.Option(metavar="X,Y,YAW", help="Pose: world metres, degrees counter-clockwise from east.")
    ],
    extent: Annotated[
        str, typer.Option("--range", metavar="LENGTHxWIDTH", help="Window around the pose, metres.")
    ] = "100x50",
    png: Annotated[Path | None, typer.Option(help="Draw the prior from above into this file.")] = None,
    generation: Shown = None,
    as_json: AsJson = False,
) -> None:
    """Read the prior around a pose."""
    from flows.query import Place, show_window

    show_window(context.obj, city, generation, Place.parse(at, extent), png, as_json)


@app.command()
def report(
    context: typer.Context,
    city: City,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the report; <workspace>/reports/CITY if not given.")
    ] = None,
) -> None:
    """Write a one-page HTML report of a city with its pictures."""
    from flows.report import write_report

    print(write_report(context.obj, city, out))


@app.command()
def synth(
    out: Annotated[Path, typer.Argument(help="Folder of the new data set.", show_default=False)],
    preset: Annotated[str, typer.Option(help="ci, demo or experiment.")] = "demo",
    seed: Annotated[int, typer.Option(min=0, help="Seed: the same seed gives the same city.")] = 0,
    override: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change the preset, for example keyframes=10 or lidar=true."),
    ] = None,
) -> None:
    """Generate the embedded city: a procedural data set in nuScenes format with ground truth."""
    from flows.demo import generate_city

    generate_city(out, preset, seed, override or [])


@app.command()
def demo(context: typer.Context, override: Overrides = None) -> None:
    """Generate the small embedded city, build its priors and show them."""
    from flows.demo import run_demo

    run_demo(context.obj, override or [])


@app.command()
def doctor(context: typer.Context, as_json: AsJson = False) -> None:
    """Show what is installed, what is missing and how to get it."""
    from flows.doctor import show_findings

    show_findings(context.obj, as_json)


app.add_typer(schedule_commands.app)
app.add_typer(store_commands.app)


def main() -> None:
    """Run the command line; one clear line and a telling exit code for every error that is ours."""
    try:
        app()
    except PresightError as error:
        _fail(error)
    except OSError as error:
        _fail(StoreError(f"{error}; check the disk's space and your access to it, then run again"))
    except ModuleNotFoundError as error:
        cure = "this command needs the whole pipeline: pip install '.[pipeline]' (README, Install)"
        _fail(MissingDependencyError(f"{error}; {cure}"))


def _fail(error: PresightError) -> NoReturn:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
