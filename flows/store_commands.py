"""The commands that look after a city's store: check it, go back in it, name, compare, clean, take out and bring in."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flows.options import AsJson, City

app = typer.Typer()

Generation = Annotated[str | None, typer.Option("--generation", help="Number or tag; the newest if not given.")]


class Layout(StrEnum):
    """The forms in which a city's priors leave the store."""

    LEGACY = "presight-legacy"
    NPY = "npy"
    PLY = "ply"
    STAC = "stac"


@app.command()
def verify(
    context: typer.Context,
    city: City,
    deep: Annotated[bool, typer.Option("--deep", help="Read every chunk and compare every byte.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check a city's store for anything that is missing, damaged or edited."""
    from flows.store_care import show_faults

    show_faults(context.obj, city, deep, as_json)


@app.command()
def log(context: typer.Context, city: City, as_json: AsJson = False) -> None:
    """Show a city's generations, the newest first, and what each changed."""
    from flows.store_care import show_history

    show_history(context.obj, city, as_json)


@app.command()
def rollback(
    context: typer.Context,
    city: City,
    generation: Annotated[int, typer.Argument(help="Generation to show again.", show_default=False)],
) -> None:
    """Publish a new generation that shows exactly what an earlier one did."""
    from flows.publication import roll_back

    number = roll_back(context.obj, city, generation)
    print(f"{city}: generation {number} shows what generation {generation} did")


@app.command()
def tag(
    context: typer.Context,
    city: City,
    name: Annotated[str | None, typer.Argument(help="Name; all tags are shown if not given.")] = None,
    generation: Annotated[int | None, typer.Option("--generation", help="The newest if not given.")] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Take the tag away.")] = False,
) -> None:
    """Name a generation for good: nothing that it shows is ever deleted."""
    from flows.store_care import change_tag

    change_tag(context.obj, city, name, generation, remove)


@app.command()
def gc(
    context: typer.Context,
    city: City,
    keep: Annotated[int, typer.Option(min=1, help="Newest generations to keep; tagged ones stay anyway.")] = 20,
    grace_days: Annotated[
        float, typer.Option(min=0.0, help="Nothing younger goes: runs at work, readers that pinned a generation.")
    ] = 7.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would go, and remove nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove old generations, and the builds that none of the others shows."""
    from datetime import timedelta

    from flows.store_care import clean
    from storage.retention import Retention

    clean(context.obj, city, Retention(keep, timedelta(days=grace_days)), dry_run, as_json)


@app.command()
def diff(
    context: typer.Context,
    city: City,
    old: Annotated[str, typer.Argument(help="Generation, number or tag.", show_default=False)],
    new: Annotated[str, typer.Argument(help="Generation, number or tag.", show_default=False)],
    png: Annotated[Path | None, typer.Option(help="Draw the changes from above into this file.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show which voxels two generations do not share, by tile."""
    from flows.store_difference import show_difference

    show_difference(context.obj, city, (old, new), png, as_json)


@app.command()
def export(
    context: typer.Context,
    city: City,
    out: Annotated[Path, typer.Option(help="Folder to write into.", show_default=False)],
    layout: Annotated[Layout, typer.Option(help="Form of the export; docs/store.md.")] = Layout.NPY,
    generation: Generation = None,
) -> None:
    """Write a city's priors in a form that other programs read."""
    from flows.store_exports import export_city

    export_city(context.obj, city, generation, layout, out)


@app.command("import")
def import_(
    context: typer.Context,
    city: City,
    files: Annotated[list[Path], typer.Argument(help="The city's released pickles, one a tile.", show_default=False)],
    space: Annotated[str, typer.Option(help="Name of the feature space they are in.")] = "presight-released",
) -> None:
    """Read the released project's pickles into a new city of the store; nothing in them is executed."""
    from flows.store_exports import import_city

    import_city(context.obj, city, files, space)
