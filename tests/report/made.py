"""Records and drawings by hand: views and pairs of a summary, and what stands in an SVG text."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from barpc.base.geodesy import Array
from barpc.report.page import SECTIONS, Section
from barpc.report.runfiles import OBSERVATION_COLUMNS, RESIDUALS, ObservationTable, RunFiles
from barpc.report.summary import SCHEMA, Summary, TablesEntry, TracksEntry
from barpc.report.summary.ground_points import GcpEntry
from barpc.report.summary.pairs import OffsetEntry, PairEntry
from barpc.report.summary.views import CorrectionEntry, ViewEntry

_VIEW: dict[str, Any] = {
    "path": "", "size": (1000, 800), "alt_range_m": (0.0, 500.0), "rpc_source": None, "gsd_m": 0.5,
    "incidence_deg": 10.0, "azimuth_deg": 90.0, "num_observations": 100, "num_rejected": 0, "num_gcps": 0,
    "tie_coverage": 0.5, "rmse_before": 2.0, "rmse_after": 0.2, "systematic_px": 0.0, "prior_scale": 1.0,
    "correction": None, "camera_center": None, "fit": None, "outputs": {}, "status": "adjusted", "advice": "",
}  # fmt: skip


def a_view(name: str = "A", **fields: Any) -> ViewEntry:
    """An image of which all is well, but for the fields given."""
    return ViewEntry(name=name, **{**_VIEW, **fields})


def a_correction(**fields: Any) -> CorrectionEntry:
    """A correction of a pixel to the right and two up, known to a tenth."""
    usual = {"model": "rotation", "unknowns": (1.0,), "sigma": (0.1,)}
    moved = {"center_shift_px": (1.0, -2.0), "center_sigma_px": (0.1, 0.1)}
    return CorrectionEntry(**{**usual, **moved, **fields})  # type: ignore[arg-type]


def a_pair(a: str = "A", b: str = "B", num: int = 100, **fields: Any) -> PairEntry:
    """A pair under 20 degrees, its offset 0.4 px before and 0.1 px after."""
    usual = {
        "convergence_deg": 20.0, "base_to_height": 0.35, "height_m_per_px": 1.4, "matching": None,
        "epipolar_before": OffsetEntry(0.3, 0.2, 0.4, num), "epipolar_after": OffsetEntry(0.0, 0.1, 0.1, num),
    }  # fmt: skip
    return PairEntry(a, b, num, **{**usual, **fields})


def a_gcp(name: str, lon: float, lat: float, **fields: Any) -> GcpEntry:
    """A ground control point that nothing was said of."""
    return GcpEntry(name, lon, lat, 0.0, (1.0, 1.0, 1.0), (None, None, None), **fields)


def a_summary(views: Sequence[ViewEntry], pairs: Sequence[PairEntry] = (), **fields: Any) -> Summary:
    """The summary of an adjustment that came out well."""
    usual = {
        "schema": SCHEMA, "barpc": "1", "kind": "adjust", "status": "good", "headline": "All well.", "verdict": (),
        "reasons": (), "passed": True, "out_dir": "", "altitude_m": 0.0, "left_out": (), "gcps": (),
        "tracks": TracksEntry(5, 12, {"2": 3, "3": 2}), "tables": TablesEntry(5, 5, complete=True), "scene": None,
        "check_points": (), "stages": (), "options": None, "versions": {},
    }  # fmt: skip
    return Summary(views=tuple(views), pairs=tuple(pairs), **{**usual, **fields})


def seen(rows: Sequence[tuple[Any, ...]]) -> ObservationTable:
    """Observations: view, track, xy, before, after, and whether each was used."""
    view, track, *numbers, used = zip(*rows, strict=True) if rows else ((),) * 6
    xy, before, after = (np.array(column, dtype=float).reshape(-1, 2) for column in numbers)
    return ObservationTable(np.array(view, int), np.array(track, int), xy, before, after, np.array(used, bool))


def files_of(
    summary: Summary,
    outlines: Sequence[Sequence[Array]] = (),
    points: Sequence[tuple[float, ...]] = (),
    observed: ObservationTable | None = None,
) -> RunFiles:
    """A run's files."""
    table = np.array(points, dtype=float).reshape(-1, 4)
    rings = outlines or [()] * len(summary.views)
    return RunFiles(summary, observed or seen([]), table, np.arange(len(table)), rings)


def without_points(folder: Path, count: int, **texts: str) -> Path:
    """The tables of a run of so many images without a tie point, but for the texts of some."""
    usual = {
        "footprints.geojson": json.dumps({"features": [{"geometry": None}] * count}),
        "observations.csv": ",".join(OBSERVATION_COLUMNS),
        "residuals.csv": ",".join(RESIDUALS),
    }
    (folder / "tables").mkdir(exist_ok=True)
    for name, text in usual.items():
        (folder / "tables" / name).write_text(texts.get(Path(name).stem, text))
    return folder


def section(files: RunFiles, key: str) -> Section | None:
    """The part of the page of a run that has a key, if there is one."""
    return next((found for make in SECTIONS if (found := make(files)) is not None and found.key == key), None)


def a_square(lon: float, lat: float, half: float = 0.01) -> list[Array]:
    """The outline of an image, closed."""
    corners = [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)]
    return [np.array(corners) + (lon, lat)]


class Drawing:
    """An SVG text, taken apart."""

    def __init__(self, svg: str) -> None:
        self.root = ElementTree.fromstring(svg)

    @property
    def box(self) -> tuple[float, float]:
        """Width and height."""
        _, _, width, height = map(float, self.root.get("viewBox", "").split())
        return width, height

    @property
    def described(self) -> str:
        """What it says to those who do not see it."""
        return self.root.findtext("desc") or ""

    def all(self, tag: str, class_: str | None = None) -> list[ElementTree.Element]:
        """Elements of a kind and class, as they come."""
        return [e for e in self.root.iter(tag) if class_ is None or e.get("class") == class_]

    def of(self, tag: str, class_: str, *names: str) -> list[tuple[float, ...]]:
        """Numbers of such elements."""
        return [tuple(float(e.get(name, "nan")) for name in names) for e in self.all(tag, class_)]

    def lines(self, class_: str) -> list[tuple[float, ...]]:
        """Straight lines: x1, y1, x2, y2."""
        return self.of("line", class_, "x1", "y1", "x2", "y2")

    def rects(self, class_: str) -> list[tuple[float, ...]]:
        """Rectangles: x, y, width, height."""
        return self.of("rect", class_, "x", "y", "width", "height")

    def texts(self, class_: str) -> list[tuple[str, float, float, str]]:
        """Texts: words, x, y, anchor."""
        found = self.all("text", class_)
        return [(e.text or "", float(e.get("x", "")), float(e.get("y", "")), e.get("text-anchor", "")) for e in found]

    def titles(self, class_: str | None = None) -> list[str]:
        """What shapes say under the pointer, by the class of their group or of what stands in it."""
        groups = [g for g in self.root.iter("g") if g.find("title") is not None]
        return [
            g.findtext("title") or ""
            for g in groups
            if class_ is None or any(e.get("class") == class_ for e in g.iter())
        ]

    def points(self, class_: str) -> list[list[tuple[float, float]]]:
        """The corners of every path of a class."""
        return [corners(e.get("d", "")) for e in self.all("path", class_)]


def corners(d: str) -> list[tuple[float, float]]:
    """The places of a path of straight lines."""
    words = d.replace("M", " ").replace("L", "|").replace("Z", "").replace("h0", "|").strip(" |")
    return [(float(word.split()[0]), float(word.split()[1])) for word in words.split("|")]
