"""A made-up map: a crossroads with an island, two crossings and three dividers."""


class Tables:
    """Tables of a map expansion, filled from coordinates around the crossroads at `middle`."""

    def __init__(self, middle: tuple[float, float]) -> None:
        self._x, self._y = middle
        layers = ("ped_crossing", "lane_divider", "road_divider", "road_segment", "lane")
        self.tables: dict[str, list[dict]] = {name: [] for name in ("node", "line", "polygon", *layers)}

    def nodes(self, corners) -> list[str]:
        first = len(self.tables["node"])
        self.tables["node"] += [
            {"token": f"node-{first + number}", "x": self._x + x, "y": self._y + y}
            for number, (x, y) in enumerate(corners)
        ]
        return [f"node-{first + number}" for number in range(len(corners))]

    def surface(self, layer: str, corners, holes=()) -> None:
        token = f"polygon-{len(self.tables['polygon'])}"
        exterior, rings = self.nodes(corners), [{"node_tokens": self.nodes(hole)} for hole in holes]
        self.tables["polygon"].append({"token": token, "exterior_node_tokens": exterior, "holes": rings})
        self.tables[layer].append({"token": f"{layer}-{token}", "polygon_token": token})

    def line(self, layer: str, corners) -> None:
        token = f"line-{len(self.tables['line'])}"
        self.tables["line"].append({"token": token, "node_tokens": self.nodes(corners)})
        self.tables[layer].append({"token": f"{layer}-{token}", "line_token": token})


def box(x_low: float, y_low: float, x_high: float, y_high: float) -> list[tuple[float, float]]:
    return [(x_low, y_low), (x_high, y_low), (x_high, y_high), (x_low, y_high)]


def crossroads(middle: tuple[float, float] = (100.0, 200.0)) -> Tables:
    tables = Tables(middle)
    tables.surface("road_segment", box(-80, -6, 0, 6))
    tables.surface("lane", box(0, -6, 80, 6), holes=[box(20, -2, 24, 2)])
    tables.surface("road_segment", box(-5, -60, 5, 60))
    tables.surface("ped_crossing", box(8, -6, 10, 6))
    tables.surface("ped_crossing", box(-5, 8, 5, 11))
    tables.line("lane_divider", [(6, 0), (80, 0)])
    tables.line("road_divider", [(-80, 1), (-6, 1)])
    tables.line("lane_divider", [(0, 10), (0, 60)])
    return tables
