"""An experiment's results for people and programs: a table of means and spreads, pictures, JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

import numpy as np

from presight_perception.experiment.runner import Outcome

LEAST_SPREAD = 2  # seeds; of a single one there is no spread to show
GROUPS = ("day", "night", "mapped ground", "new ground")
MAP_FIGURES = ("mean", "ped_crossing", "divider", "boundary")
OCCUPANCY_FIGURES = ("mean", "static", "dynamic")


def write_report(name: str, outcomes: Sequence[Outcome], pictures: Sequence[Path], facts: dict, folder: Path) -> Path:
    """Write results.json, table.md and index.html into a folder; the page's path.

    facts: what else a reader of the figures must know, JSON values by name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            "label": each.row.label,
            "run": asdict(each.row.run) if each.row.run else None,
            "probe": asdict(each.row.probe),
            "figures": each.figures,
        }
        for each in outcomes
    ]
    results = {"experiment": name, "facts": facts, "rows": rows}
    (folder / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    columns, lines = table_of(outcomes)
    (folder / "table.md").write_text(_markdown(columns, lines), encoding="utf-8")
    page = folder / "index.html"
    page.write_text(_html(name, columns, lines, pictures, facts), encoding="utf-8")
    return page


def table_of(outcomes: Sequence[Outcome]) -> tuple[list[str], list[list[str]]]:
    """Column names and a line for each label: the mean over its seeds, and their spread (standard deviation)."""
    is_map = "static" not in outcomes[0].figures["all"]
    names = MAP_FIGURES if is_map else OCCUPANCY_FIGURES
    groups = ["all", *(group for group in GROUPS if group in outcomes[0].figures)]
    cells = [("all", name) for name in names] + [(group, "mean") for group in groups[1:]] + [("all", "fps")]
    by_label: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_label.setdefault(outcome.row.label, []).append(outcome)
    lines = []
    for label, seeds in by_label.items():
        values = [[each.figures[group].get(name, np.nan) for each in seeds] for group, name in cells]
        lines.append([label, *(_mean_and_spread(value) for value in values), str(len(seeds))])
    titles = [name if group == "all" else f"{name}, {group}" for group, name in cells[:-1]]
    return ["", *titles, "frames/s", "seeds"], lines


def _mean_and_spread(values: list[float]) -> str:
    if np.isnan(values).any():
        return ""  # what a row has no figure of
    mean = f"{np.mean(values):.1f}"
    return mean if len(values) < LEAST_SPREAD else f"{mean} ± {np.std(values, ddof=1):.1f}"


def _markdown(columns: list[str], lines: list[list[str]]) -> str:
    rule = ["---", *["---:"] * (len(columns) - 1)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in [columns, rule, *lines])


def _html(name: str, columns: list[str], lines: list[list[str]], pictures: Sequence[Path], facts: dict) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in line) + "</tr>" for line in lines)
    images = "".join(f'<p><img src="{escape(file.name)}" alt="{escape(file.stem)}"></p>' for file in pictures)
    known = "".join(f"<li>{escape(key)}: {escape(str(value))}</li>" for key, value in facts.items())
    style = (
        "body{font-family:sans-serif;margin:2em}td,th{padding:.2em .8em;text-align:right}"
        "td:first-child{text-align:left}img{max-width:100%}"
    )
    return (
        f"<!doctype html><meta charset=utf-8><title>{escape(name)}</title><style>{style}</style>"
        f"<h1>{escape(name)}</h1><table><tr>{head}</tr>{body}</table><ul>{known}</ul>{images}"
    )
