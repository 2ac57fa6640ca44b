"""The matrix of the pairs: a cell for each two images, shaded by matches, epipolar offset or angle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from barpc.report.charts import WIDTH, coordinate, label, sheet, shortened, tag
from barpc.report.summary.pairs import PairEntry
from barpc.report.tables import RunFiles

_LEFT = 30.0  # at least: names are to its right end
_TOP = 18.0
_CHARACTER = 8.2  # units of a character at the sides
_LONGEST = 10  # characters of a name there
_TEXTS = 12  # images: of no more the figures stand in the cells


@dataclass(frozen=True)
class Measure:
    """What a shade stands for: a key, words, its value in a pair, how it is written, and the limits of the shades."""

    key: str
    words: str
    value: Callable[[PairEntry], float | None]
    form: str
    limits: tuple[float, ...]

    def shade(self, value: float) -> int:
        """Return the number of the shade of a value."""
        return sum(value >= limit for limit in self.limits)

    @property
    def legend(self) -> list[str]:
        """What each shade says."""
        low, high = self.limits[0], self.limits[-1]
        between = [f"{a:g} to {b:g}" for a, b in pairwise(self.limits)]
        return [f"below {low:g}", *between, f"{high:g} and more"]


MEASURES = (
    Measure("matches", "matches", lambda p: p.num_matches, ".0f", (10, 30, 100, 300, 1000)),
    Measure("offset", "epipolar offset, RMS [px]", lambda p: p.offset_rms[-1], ".2f", (0.05, 0.1, 0.2, 0.5, 1)),
    Measure("angle", "angle of convergence [deg]", lambda p: p.convergence_deg, ".1f", (1, 5, 15, 35, 60)),
)


def pair_matrix(files: RunFiles) -> str:
    """Draw the matrix of pairs: rows and columns are the images by name, below the diagonal stand the shades."""
    views, pairs, index = files.summary.views, files.summary.pairs, files.number
    names = [shortened(view.name, _LONGEST) for view in views]
    left = max(_LEFT, _CHARACTER * max(map(len, names)) + 6.0)
    side = (WIDTH - left - 4) / len(views)
    cells = [(min(ends), max(ends), p) for p in pairs for ends in [(index[p.a], index[p.b])]]
    parts = [
        tag("rect", x=left, y=_TOP, width=side * len(views), height=side * len(views), class_="empty"),
        *_names(names, side, left),
    ]
    for place, measure in enumerate(MEASURES):
        layer = _layer(measure, cells, side, (len(views), left))
        parts.append(tag("g", *layer, class_=f"layer l{place}", data_words=measure.words))
    parts.append(tag("rect", x=0, y=0, width=side, height=side, class_="cursor"))
    return sheet(
        "matrix-chart",
        "Matrix of the pairs",
        f"{len(views)} images, {len(pairs)} pairs; the figures are in the table of pairs.",
        _TOP + side * len(views) + 4,
        parts,
        class_="matrix",
        data_side=side,
        data_left=left,
        data_top=_TOP,
    )


def facts(files: RunFiles) -> dict[str, list[list[object]]]:
    """Return what the page's script says of an image or a pair that is pointed at: names, pairs with figures."""
    index = files.number
    names: list[list[object]] = [[view.name, view.num_observations] for view in files.summary.views]
    pairs: list[list[object]] = []
    for pair in files.summary.pairs:
        a, b = sorted((index[pair.a], index[pair.b]))
        values = [(m.value(pair), m.form) for m in MEASURES]
        pairs.append([a, b, *("" if value is None else format(value, form) for value, form in values)])
    return {"views": names, "pairs": pairs}


def _names(names: Sequence[str], side: float, left: float) -> list[str]:
    """Draw names at the left and above, as many as have room."""
    wide = _CHARACTER * max(map(len, names)) + 6.0
    steps = 1, 2, 5, 10, 20, 50, 100, 200, 500
    step = next((s for s in steps if s * side >= max(15.0, wide)), 1000)
    parts = []
    for k in range(0, len(names), step):
        middle = side * (k + 0.5)
        half = 0.5 * _CHARACTER * len(names[k])
        parts.append(label(min(left + middle, WIDTH - half), _TOP - 5, names[k], "middle"))
        parts.append(label(left - 4, _TOP + middle + 4, names[k], "end"))
    return parts


def _layer(
    measure: Measure, cells: Sequence[tuple[int, int, PairEntry]], side: float, whole: tuple[int, float]
) -> list[str]:
    num, left = whole
    shades: dict[int, list[str]] = {}
    texts = []
    box = f"h{coordinate(side)}v{coordinate(side)}h-{coordinate(side)}z"
    for a, b, pair in cells:
        value = measure.value(pair)
        if value is None:
            continue
        x, y = left + b * side, _TOP + a * side
        shades.setdefault(measure.shade(value), []).append(f"M{coordinate(x)} {coordinate(y)}{box}")
        if num <= _TEXTS:
            middle = x + side / 2, y + side / 2 + 4
            texts.append(label(*middle, format(value, measure.form), "middle", "value"))
    parts = [tag("path", d="".join(d), class_=f"cell s{k}") for k, d in sorted(shades.items())]
    return [*parts, *texts, *_legend(measure, side * num, left)]


def _legend(measure: Measure, whole: float, left: float) -> list[str]:
    """Draw the legend in the lower left, where no pair stands."""
    top = _TOP + whole - 18 * len(measure.legend) - 6
    parts = [label(left + 8, top - 6, measure.words, class_="axis")]
    for k, words in enumerate(measure.legend):
        y = top + 18 * k
        parts.append(tag("rect", x=left + 8, y=y, width=14, height=14, class_=f"cell s{k}"))
        parts.append(label(left + 28, y + 11, words))
    return parts
