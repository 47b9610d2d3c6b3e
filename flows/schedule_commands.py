"""`presight deploy` and `presight serve-flows`: cities that a Prefect server keeps current."""

from typing import Annotated

import typer

from flows.options import AsJson, City, Cluster, Runner

app = typer.Typer()

Pool = Annotated[str, typer.Option(help="Work pool of the Prefect server.")]


@app.command()
def deploy(
    context: typer.Context,
    city: City,
    cron: Annotated[
        list[str] | None,
        typer.Option(metavar="[FLOW=]CRON", help="When a flow starts, rebuild if none is named; may be given again."),
    ] = None,
    timezone: Annotated[str, typer.Option(help="Zone of the schedules, for example Asia/Singapore.")] = "UTC",
    on_ingest: Annotated[bool, typer.Option("--on-ingest", help="Start an update when a drive was ingested.")] = False,
    pool: Pool = "presight",
    runner: Runner = "threads",
    cluster: Cluster = "",
    remove: Annotated[bool, typer.Option("--remove", help="Take all of the city off the server.")] = False,
    as_json: AsJson = False,
) -> None:
    """Register a city's flows on the Prefect server of PREFECT_API_URL, in place of what was registered."""
    from flows.deploy import Asked, register_city, remove_city

    if remove:
        remove_city(context.obj, city, as_json)
    else:
        asked = Asked(cron or [], timezone, on_ingest, pool, runner, cluster)
        register_city(context.obj, city, asked, as_json)


@app.command("serve-flows")
def serve_flows(
    pool: Pool = "presight",
    limit: Annotated[int | None, typer.Option(min=1, help="Runs at once; any number if not given.")] = None,
) -> None:
    """Run what the Prefect server of PREFECT_API_URL has to run, until stopped."""
    from flows.deploy import serve

    serve(pool, limit)
