"""Draw docs/figures/architecture.svg from the code: layers, and three journeys through them.

python docs/figures/architecture.py            # writes it

The layers are those of pyproject.toml, which import-linter enforces. A stop of a journey is a function; the next
one must be named in the module of the one before, or nothing is drawn.
"""

from __future__ import annotations

import re
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUT = Path(__file__).with_suffix(".svg")
JOURNEYS = {
    "images -> files": (
        ("pipeline/run.py", "adjust", "paths"),
        ("pipeline/loading.py", "load_views", "paths -> views with cameras"),
        ("pipeline/adjusting.py", "tied_and_adjusted", "views -> tracks -> cameras"),
        ("tie/tracks.py", "find_tracks", "views -> tracks"),
        ("ba/adjustment.py", "adjust_tracks", "tracks -> cameras P_BA"),
        ("fit/refit.py", "fit_rpc", "P_BA -> RPC and its certificate"),
        ("pipeline/outputs.py", "write_views", "RPCs -> files, read again and compared"),
        ("pipeline/outputs.py", "write_tables", "the run -> summary, tables, report"),
    ),
    "tracks -> correction": (
        ("ba/adjustment.py", "adjust_tracks", "views, tracks, control"),
        ("ba/constraints/block.py", "join", "-> one block, sorted by view"),
        ("ba/robust/heldout.py", "keep_out", "a tenth of the tracks aside"),
        ("ba/select/models.py", "select_model", "-> the model that the data choose"),
        ("ba/solution.py", "solve_block", "one model, its control tested"),
        ("ba/constraints/block.py", "make_problem", "cameras, priors, structure"),
        ("ba/robust/rounds.py", "Rounds", "search, cut, solve until nothing changes"),
        ("ba/solving/solve.py", "minimise", "scipy or sparse Levenberg-Marquardt"),
        ("ba/robust/heldout.py", "measure", "what the tenth says"),
        ("ba/constraints/gauge.py", "gauge_report", "where the scene went, how well that is known"),
    ),
    "model -> RPC": (
        ("fit/refit.py", "fit_rpc", "any sensor model"),
        ("fit/points.py", "control_points", "-> a grid of ground and image points"),
        ("fit/methods.py", "solve", "-> coefficients, ridge first"),
        ("fit/system.py", "FitProblem", "-> the linearised system, its triangle"),
        ("fit/methods.py", "region_of", "-> where no pole may be"),
        ("fit/certificate.py", "roundtrip", "-> the certificate, on points that the fit has not seen"),
    ),
}
INK, PAPER, LINE, SOFT = "#1d2a35", "#ffffff", "#2e86ab", "#e8f1f5"
_ROW, _WIDTH = 34, 1180


def layers() -> list[list[str]]:
    """The layers of pyproject.toml, the highest first, without the package's name."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (found,) = [c for c in table["tool"]["importlinter"]["contracts"] if c["name"] == "layers"]
    return [[name.strip().removeprefix("barpc.") for name in row.split("|")] for row in found["layers"]]


def broken(journey: tuple[tuple[str, str, str], ...]) -> list[str]:
    """Stops that are not defined where they are said to be, or that nothing before them in the journey names."""
    missing, seen = [], ""
    for path, name, _ in journey:
        text = (ROOT / "barpc" / path).read_text(encoding="utf-8")
        defined = re.search(rf"^(def|class) {name}\b", text, re.MULTILINE)
        if not defined or (seen and not re.search(rf"\b{name}\(", seen)):
            missing.append(f"{path}: {name}")
        seen += text
    return missing


def _text(x: float, y: float, text: str, style: str = "") -> str:
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(text)}</text>'


def _box(x: float, y: float, width: float, fill: str) -> str:
    return f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{_ROW - 8}" rx="4" fill="{fill}" stroke="{LINE}"/>'


def drawing() -> str:
    """The picture."""
    for title, journey in JOURNEYS.items():
        if wrong := broken(journey):
            raise SystemExit(f"{title}: {', '.join(wrong)}: not there, or not called")
    out, y = (
        [_text(20, 26, "Layers: what stands higher imports what stands lower", 'font-weight="bold"')],
        40.0,
    )
    for row in layers():
        width = (_WIDTH - 40) / len(row)
        for n, name in enumerate(row):
            out += [
                _box(20 + n * width, y, width - 6, SOFT),
                _text(30 + n * width, y + 18, name),
            ]
        y += _ROW
    for title, journey in JOURNEYS.items():
        y += 30
        rooms = len({path for path, _, _ in journey})
        out.append(_text(20, y - 6, f"{title}: {rooms} modules", 'font-weight="bold"'))
        for n, (path, name, what) in enumerate(journey):
            if n:
                out.append(f'<path d="M40 {y - 8:g} v8" stroke="{LINE}" stroke-width="2"/>')
            out += [
                _box(20, y, 420, PAPER),
                _text(30, y + 18, f"{path.removesuffix('.py')}.{name}"),
                _text(460, y + 18, what),
            ]
            y += _ROW
    style = f'font-family="sans-serif" font-size="14" fill="{INK}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {y + 10:g}" {style}>'
    return "\n".join([head, f'<rect width="100%" height="100%" fill="{PAPER}"/>', *out, "</svg>", ""])


if __name__ == "__main__":
    OUT.write_text(drawing(), encoding="utf-8")
