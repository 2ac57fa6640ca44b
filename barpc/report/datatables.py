"""The tables of the report: what each shows, ready for the template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.report.compare import flat_options
from barpc.report.verdict import STATUS_WORDS

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Cell:
    """One cell.

    Parameters
    ----------
    text : str
        As shown.
    key : float or str
        What it is sorted by.
    kind : str
        CSS class: a status, or "number", "name".
    """

    text: str
    key: float | str
    kind: str = "number"


MAX_TABLE_ROWS = 1000
"""A table of the page shows so many rows; the files beside it have all."""


@dataclass(frozen=True)
class DataTable:
    """A table with its caption and the heads of its columns, units in them; `folded` ones open on demand."""

    key: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    folded: bool = False

    @property
    def shown(self) -> Sequence[Sequence[Cell]]:
        """The rows on the page."""
        return self.rows[:MAX_TABLE_ROWS]

    @property
    def heading(self) -> str:
        """The caption, which says where rows are missing."""
        if len(self.rows) <= MAX_TABLE_ROWS:
            return self.caption
        return f"{self.caption}; the first {MAX_TABLE_ROWS} of {len(self.rows)}, all in the files beside this page"

    @property
    def kinds(self) -> list[str]:
        """How each column is set: "text" on the left, "number" on the right."""
        first = self.rows[0] if self.rows else []
        kinds = ["number" if cell.kind == "number" else "text" for cell in first]
        return kinds or ["text"] * len(self.columns)


def figure(value: float | None, form: str = ".3f") -> Cell:
    """A number; nothing is a dash that sorts last."""
    if value is None:
        return Cell("-", 1e300)
    return Cell(format(value, form) if value else "0", float(f"{value:.6g}"))


def largest(values: Sequence[float | None]) -> float | None:
    """The largest number; None where one is missing, which may be larger."""
    known = [value for value in values if value is not None]
    return max(known) if known and len(known) == len(values) else None


def name(text: str) -> Cell:
    """A name."""
    return Cell(text, text, "name")


def views_table(summary: Record) -> DataTable:
    """One row an image."""
    adjusted = summary["kind"] == "adjust"
    columns = ["#", "image", "verdict", "tie points", "rejected [%]", "covered [%]", "before [px]"]
    columns += ["after [px]", "shift col, row [px]"] if adjusted else []
    columns += ["GSD [m]", "incidence [deg]", "RPC read from"]
    rows = []
    for k, view in enumerate(summary["views"]):
        every = view["num_observations"] + view["num_rejected"]
        row = [
            figure(k + 1, ".0f"),
            name(view["name"]),
            Cell(
                STATUS_WORDS[view["status"]],
                list(STATUS_WORDS).index(view["status"]),
                f"status {view['status']}",
            ),
            figure(view["num_observations"], ".0f"),
            figure(100 * view["num_rejected"] / every if every else None, ".1f"),
            figure(100 * view["tie_coverage"], ".0f"),
            figure(view["rmse_before"]),
        ]
        if adjusted:
            row += [figure(view["rmse_after"]), _shift(view)]
        source = "-" if view["rpc_source"] is None else view["rpc_source"]["format"]
        rows.append([*row, figure(view["gsd_m"], ".2f"), figure(view["incidence_deg"], ".1f"), name(source)])
    return DataTable("images", "Images: reprojection error (RMS) of the tie points that count", columns, rows)


def _shift(view: Record) -> Cell:
    shift = None if view["correction"] is None else view["correction"]["center_shift_px"]
    if shift is None or None in shift:
        return figure(None)
    return Cell(f"{shift[0]:+.2f}, {shift[1]:+.2f}", float(f"{max(map(abs, shift)):.6g}"))


def corrections_table(summary: Record) -> DataTable:
    """What was changed in each camera, with what the adjustment predicts for its error."""
    columns = [
        "image",
        "col [px]",
        "row [px]",
        "rotation [urad]",
        "translation [m]",
        "camera centre [km]",
        "found by",
    ]
    rows = []
    for view in summary["views"]:
        correction, center = view["correction"], view["camera_center"]
        altitude = None if center is None else center["altitude_m"]
        moves = zip(correction["center_shift_px"], correction["center_sigma_px"], strict=True)
        rows.append(
            [
                name(view["name"]),
                *(Cell(f"{shift:+.3f} ± {sigma:.2f}", shift) for shift, sigma in moves),
                figure(correction.get("angle_urad"), ".2f"),
                figure(correction.get("translation_norm_m"), ".2f"),
                figure(altitude and altitude / 1e3, ".0f"),
                name("-" if center is None else center["method"]),
            ]
        )
    caption = "Corrections: shift in the middle of the image ± one sigma, size of rotation and translation"
    return DataTable("corrections", caption, columns, rows, folded=True)


def pairs_table(summary: Record) -> DataTable:
    """One row a pair."""
    adjusted = summary["kind"] == "adjust"
    columns = ["#", "pair", "matches", "angle [deg]", "B/H", "height per px [m]", "before [px]"]
    columns += ["after [px]"] if adjusted else []
    rows = []
    number = {view["name"]: k + 1 for k, view in enumerate(summary["views"])}
    for pair in summary["pairs"]:
        first, second = number[pair["a"]], number[pair["b"]]
        row = [
            Cell(f"{first}-{second}", first + second / 1e6),
            name(f"{pair['a']} - {pair['b']}"),
            figure(pair["num_matches"], ".0f"),
            figure(pair["convergence_deg"], ".1f"),
            figure(pair["base_to_height"], ".2f"),
            figure(pair["height_m_per_px"], ".3g"),
        ]
        rows.append(
            [*row, *(_offset(pair[f"epipolar_{when}"]) for when in ("before", "after")[: 1 + adjusted])]
        )
    caption = "Pairs: distance of matches from the epipolar line, median ± spread (1.4826 MAD)"
    return DataTable("pairs", caption, columns, rows)


def _offset(offset: Record | None) -> Cell:
    if offset is None:
        return figure(None)
    return Cell(f"{offset['median']:+.3f} ± {offset['spread']:.3f}", float(f"{abs(offset['median']):.6g}"))


def fits_table(summary: Record) -> DataTable:
    """The certificate of every refitted RPC."""
    columns = ["image", "RMSE col, row [px]", "largest [px]", "smallest denominator", "round trip [px]"]
    columns += ["covered [%]", "check points", "solver"]
    rows = []
    for view in summary["views"]:
        fit = view["fit"]
        rmse = figure(None)
        if None not in fit["rmse_px"]:
            rmse = Cell(", ".join(f"{value:.1e}" for value in fit["rmse_px"]), max(fit["rmse_px"]))
        rows.append(
            [
                name(view["name"]),
                rmse,
                figure(largest(fit["max_px"]), ".1e"),
                figure(fit["min_denominator"]),
                figure(fit["roundtrip_px"], ".1e"),
                figure(None if fit["coverage"] is None else 100 * fit["coverage"], ".0f"),
                figure(fit["num_check_points"], ".0f"),
                name(fit["method"]),
            ]
        )
    return DataTable("fits", "Refitted RPCs against P_BA, on points that the fit has not seen", columns, rows)


def files_table(summary: Record) -> DataTable:
    """Every file with a new RPC, and what each consumer that reopened it read."""
    outputs = {file: found for view in summary["views"] for file, found in view["outputs"].items()}
    consumers = list(dict.fromkeys(consumer for found in outputs.values() for consumer in found))
    rows = [[name(file), *(_reading(found.get(c)) for c in consumers)] for file, found in outputs.items()]
    caption = "Files reopened as their readers do: largest difference to P_BA [px]"
    return DataTable("files", caption, ["file", *(f"{consumer} [px]" for consumer in consumers)], rows)


def _reading(found: float | str | None) -> Cell:
    """What a consumer read, or why it did not."""
    return Cell(found, 1e301) if isinstance(found, str) else figure(found, ".1e")


def gcps_table(summary: Record) -> DataTable:
    """Adjusted GCPs minus their given place."""
    columns = ["GCP", "east [m]", "north [m]", "up [m]", "sigma east, north, up [m]"]
    rows = []
    for gcp in summary["gcps"]:
        sigma = Cell(", ".join(f"{s:.2g}" for s in gcp["sigma_m"]), max(gcp["sigma_m"]))
        rows.append([name(gcp["name"]), *(figure(r, "+.3f") for r in gcp["residual_enu_m"]), sigma])
    return DataTable("gcps", "Ground control: adjusted minus given place", columns, rows)


def check_points_table(summary: Record) -> DataTable:
    """Check points: where the new cameras put them minus where they are."""
    columns = ["check point", "images", "in the images [px]", "east [m]", "north [m]", "up [m]"]
    rows = []
    for point in summary["check_points"]:
        seen = [o["residual_px"] for o in point["observations"] if None not in o["residual_px"]]
        rms = float(np.sqrt(np.mean(np.square(seen).sum(axis=1)))) if seen else None
        left = [figure(value, "+.3f") for value in point["residual_enu_m"]]
        rows.append([name(point["name"]), figure(len(seen), ".0f"), figure(rms), *left])
    return DataTable("check-points", "Check points: found minus given place", columns, rows)


def stages_table(summary: Record) -> DataTable:
    """Seconds and memory of the stages."""
    columns = ["stage", "seconds", "CPU seconds", "peak memory [MB]"]
    forms = {"seconds": ".2f", "cpu_seconds": ".2f", "peak_memory_mb": ".0f"}
    rows = [
        [name(stage["stage"]), *(figure(stage[key], form) for key, form in forms.items())]
        for stage in summary["stages"]
    ]
    return DataTable("stages", "Stages of the run", columns, rows, folded=True)


def options_table(summary: Record) -> DataTable:
    """Every option of the run."""
    flat = flat_options(summary["options"] or {})
    rows = [[name(key), name(str(value))] for key, value in flat.items()]
    return DataTable("options", "Options of the run", ["option", "value"], rows, folded=True)
