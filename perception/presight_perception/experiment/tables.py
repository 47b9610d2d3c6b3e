"""The paper's tables as lists of rows: which trained model is tried how."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from presight_core.errors import InputError
from presight_perception.dataset import PositionNoise
from presight_perception.experiment.runs import (
    LINE_MODELS,
    MAP_MODELS,
    OCCUPANCY_MODELS,
    ModelName,
    PriorKind,
    Probe,
    Run,
    Schedule,
)

FB_OCC_RATE = 1e-2  # its focal loss starts with every class likely everywhere; after 40 steps it is 2.3, at 3e-3 9.4
LINE_STEPS = 5  # of a decoder of lines for each step of the raster mapper that it learns from
NOISE_M = (0.25, 0.5, 1.0)  # standard deviations of the vehicle's position (Table 6)


@dataclass(frozen=True)
class Row:
    """One line of a table, of one seed; a line's seeds are shown as mean and spread."""

    label: str
    run: Run | None  # None: no model; the best constant mask
    probe: Probe = field(default_factory=Probe)


@dataclass(frozen=True)
class Scope:
    """How much of an experiment to do."""

    seeds: int = 3
    schedule: Schedule = field(default_factory=Schedule)
    model: ModelName | None = None  # of the tables about one model; None: the paper's, or the first of its kind
    colours: bool = False  # whether there are priors with features that nothing was learned for

    def rows(self, label: str, model: ModelName, prior: PriorKind, *probes: tuple[str, Probe]) -> list[Row]:
        """A run of every seed, under every probe."""
        return [
            Row(f"{label}{suffix}", self._run(model, prior, seed), probe)
            for suffix, probe in probes or [("", Probe())]
            for seed in range(self.seeds)
        ]

    def prior_only(self, label: str, model: ModelName) -> list[Row]:
        """A model without cameras, of every seed."""
        runs = [self._run(model, "presight", seed) for seed in range(self.seeds)]
        return [Row(label, replace(run, cameras=False)) for run in runs]

    def _run(self, model: ModelName, prior: PriorKind, seed: int) -> Run:
        if model in LINE_MODELS:
            return Run(model, prior, seed=seed, schedule=self.lines_schedule, masks=self.schedule)
        schedule = self.schedule
        if model in OCCUPANCY_MODELS:  # whose samples are large
            schedule = replace(schedule, batch_size=2)
        if model == "fb-occ":
            schedule = replace(schedule, learning_rate=FB_OCC_RATE)
        return Run(model, prior, seed=seed, schedule=schedule)

    @property
    def lines_schedule(self) -> Schedule:
        """Of a decoder of lines that looks into a raster mapper's bird's-eye view."""
        return Schedule(LINE_STEPS * self.schedule.steps, 8, 1.5e-3)


def headline(scope: Scope) -> list[Row]:
    """One model with and without prior, and what shows whether it uses both its senses."""
    model = scope.model or "raster"
    probes = [
        ("", Probe()),
        (", half of the prior's drives", Probe(drives="half")),
        (", no prior when tried", Probe(drives="none")),
        (", prior mirrored", Probe(mirrored=True)),
        (", online features zeroed", Probe(cameras=False)),
    ]
    rows = [Row("constant mask", None)] if model == "raster" else []
    rows += scope.rows(f"{model}, cameras", model, "none")
    rows += scope.rows(f"{model}, cameras and prior", model, "presight", *probes)
    return rows + scope.prior_only(f"{model}, prior alone", model)


def maps(scope: Scope) -> list[Row]:
    """Table 1: the map models with and without prior."""
    return _pairs(scope, (scope.model,) if scope.model else MAP_MODELS)


def occupancy(scope: Scope) -> list[Row]:
    """Table 2: the occupancy models with and without prior."""
    return _pairs(scope, (scope.model,) if scope.model else OCCUPANCY_MODELS)


def priors(scope: Scope) -> list[Row]:
    """Table 3: kinds of prior."""
    model = scope.model or "raster"
    names: dict[PriorKind, str] = {"none": "no prior", "lidar": "lidar history"}
    if model == "raster":  # the only one it is for, as in the paper
        names["nmp"] = "Neural Map Prior"
    names["presight"] = "PreSight"
    return [row for kind, name in names.items() for row in scope.rows(f"{model}, {name}", model, kind)]


def features(scope: Scope) -> list[Row]:
    """Table 4: what the prior's features are worth."""
    model = scope.model or "raster"
    names: dict[PriorKind, str] = {"none": "no prior", "geometry": "without features"}
    if scope.colours:
        names["colours"] = "colour statistics"
    names["presight"] = "with features"
    return [row for kind, name in names.items() for row in scope.rows(f"{model}, {name}", model, kind)]


def drives(scope: Scope) -> list[Row]:
    """Table 5: how many of the prior's drives there are when the model is tried."""
    model = scope.model or "raster"
    probes = [(f", {drives} of the drives", Probe(drives=drives)) for drives in ("none", "half", "all")]
    return scope.rows(model, model, "presight", *probes)


def noise(scope: Scope) -> list[Row]:
    """Table 6: a wrong position, in the paper's form and in the released code's."""
    model = scope.model or "raster"
    probes = [("", Probe())] + [
        (f", {deviation:g} m, {form} form", Probe(noise=PositionNoise(deviation, form)))
        for form in ("paper", "released")
        for deviation in NOISE_M
    ]
    return scope.rows(model, model, "presight", *probes)


def prior_only(scope: Scope) -> list[Row]:
    """Table 7: the prior alone, (a) with zeros for online features, (b) trained without cameras."""
    model = scope.model or "raster"
    rows = scope.rows(f"{model}, both", model, "presight")
    rows += scope.rows(f"{model}, (a) zeros for cameras", model, "presight", ("", Probe(cameras=False)))
    return rows + scope.prior_only(f"{model}, (b) trained without cameras", model)


TABLES: dict[str, Callable[[Scope], list[Row]]] = {
    "headline": headline,
    "maps": maps,
    "occupancy": occupancy,
    "priors": priors,
    "features": features,
    "drives": drives,
    "noise": noise,
    "prior-only": prior_only,
}


def rows_of(name: str, scope: Scope) -> list[Row]:
    """The rows of a table. Raises InputError for a name that no table has."""
    if name not in TABLES:
        raise InputError(f"no experiment is named {name!r}; choose one of: {', '.join(TABLES)}")
    return TABLES[name](scope)


def _pairs(scope: Scope, models: tuple[ModelName, ...]) -> list[Row]:
    kinds: dict[PriorKind, str] = {"none": "cameras", "presight": "cameras and prior"}
    return [
        row for model in models for kind, name in kinds.items() for row in scope.rows(f"{model}, {name}", model, kind)
    ]
