"""Types and words that the records of summary.json share; the table of an image's reservations, `CAUSES`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from barpc.base.geodesy import Array
from barpc.report.records import Number
from barpc.scene import IntArray

STATUS_WORDS = {
    "adjusted": "adjusted",
    "consistent": "consistent",
    "tied": "matched",
    "weak": "weakly connected",
    "doubtful": "needs review",
    "failed": "not adjusted",
}
"""Status of a view -> its displayed word, from good to bad."""

Count = Annotated[int, Meta(ge=0)]
Side = Annotated[int, Meta(ge=1)]
Share = Annotated[float, Meta(ge=0, le=1)]
Pixel = tuple[Number, Number]
Vector = tuple[Number, Number, Number]
ABOVE = "m above the ellipsoid"


def largest(values: Sequence[float | None] | None) -> float | None:
    """Return the largest number; None where any is missing."""
    return None if not values or None in values else max(value for value in values if value is not None)


NAMED = 5
"""Images, points or reasons that one sentence names."""


def counted(number: int, noun: str) -> str:
    """Return a number and its noun, in the plural where needed.

    Examples
    --------
    >>> counted(1, "image"), counted(2, "image")
    ('1 image', '2 images')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def capital(text: str) -> str:
    """Return a text that begins with a capital letter."""
    return text[:1].upper() + text[1:]


def median(values: Iterable[float | None]) -> float:
    """Return the median of the finite numbers; NaN without any."""
    found = np.array(list(values), dtype=np.float64)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) else float("nan")


def known(value: float | None) -> float:
    """Return a number; NaN for None."""
    return float("nan") if value is None else value


def two_digits(value: float) -> str:
    """Return a number with two digits.

    Examples
    --------
    >>> two_digits(33.11), two_digits(0.256), two_digits(684.0)
    ('33', '0.26', '680')
    """
    return f"{float(f'{value:.2g}'):g}"


def metres(value: float) -> str:
    """Return a length of two digits with a unit that keeps it readable.

    Examples
    --------
    >>> metres(3.14159), metres(53.9), metres(684.0), metres(0.0421), metres(0.00012)
    ('3.1 m', '54 m', '680 m', '4.2 cm', '0.1 mm')
    """
    scaled = ((float(f"{value * factor:.2g}"), unit) for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")))
    length, unit = next((one for one in scaled if abs(one[0]) >= 1.0), (value * 1e3, "mm"))
    return f"{length:.{1 if abs(length) < 10.0 else 0}f} {unit}"


@dataclass(frozen=True)
class Cause:
    """A reservation: its verdict, its label, its sentence and remedy, with figures in braces."""

    status: Literal["failed", "weak", "doubtful"]
    label: str
    sentence: str
    remedy: str = ""

    def advice(self, **figures: object) -> str:
        """Return the sentence with its figures, and the remedy as another one."""
        return ". ".join(capital(text.format_map(figures)) for text in (self.sentence, self.remedy) if text)


_ITS_RPC = "check that the RPC belongs to this image (IMAGE,camera=FILE names another)"
_DISTURBED = "check for clouds, water, change"
CAUSES = {
    "no_overlap": Cause("failed", "in no matched pair",
        "no pair was selected for matching (overlap, angle or list), and the camera was not changed",
        "check its RPC (IMAGE,camera=FILE names another), or lower [tie] min_overlap in a file given with --options"),
    "untied": Cause("failed", "not connected to the others",
        "no tie points lead to the main group of images{tried}, and the camera was not changed",
        "check for clouds, water and other dates, or supply matches (--matches)"),
    "other_rpc": Cause("failed", "RPC does not match the image",
        "its RPC does not match the image: {strangeness}. These were adjusted without it, and its camera was not "
        "changed",
        _ITS_RPC),
    "contradicts_all": Cause("failed", "contradicts the others",
        "{strangeness}. They were adjusted without it, and its camera was not changed",
        f"{_ITS_RPC}, and for clouds, water, change"),
    "one_rpc_misses": Cause("failed", "RPC fit misses its tolerance",
        "one RPC does not fit the corrected camera to {tolerance:g} px", "lower --drift, or use its grid (--grids)"),
    "other_pixels": Cause("doubtful", "RPC of other pixels", "{doubt}",
        "give the RPC of these pixels (IMAGE,camera=FILE)"),
    "contradicted": Cause("doubtful", "contradicts the others",
        "{share:.0f} % of its tie points were rejected, as they contradict those of the other images",
        f"{_ITS_RPC}, and for clouds, water, change"),
    "whole_pixels": Cause("weak", "matched at whole pixels",
        "tie points were matched at whole pixels, so all may share an error of {shared:.1f} px",
        "add ground points, an image of another date, or matches (--matches)"),
    "few": Cause("weak", "few tie points", "only {few} tie points", "check overlap, clouds and dates"),
    "none": Cause("weak", "no tie points", "no tie points", "check overlap, clouds and dates"),
    "few_gcps": Cause("weak", "few GCPs", "only {gcps} and no tie point constrain it, so an error would hardly show",
        "give three or more"),
    "copy": Cause("doubtful", "duplicate image", "shows the same pixels as {other}", "give each image once"),
    "foreign_camera": Cause("doubtful", "RPC does not match the image",
        "its RPC {stated}: {strangeness}. It was resected from the tie points of the other images",
        _ITS_RPC),
    "odd": Cause("doubtful", "RPC less accurate than stated",
        "its RPC is {scale:.0f} times less accurate than stated, relative to the other images{either}",
        _ITS_RPC),
    "systematic": Cause("doubtful", "systematic residuals",
        "systematic residuals of {size:.2f} px {along} remain: {why}",
        "compare with other matches (--matches)"),
    "rejected": Cause("doubtful", "many tie points rejected",
        "{share:.0f} % of its tie points were rejected; neighbours err in the same direction, so it is no noise{place}",
        _DISTURBED),
    "wrong_matches": Cause("doubtful", "wrong matches",
        "{share:.0f} % of its tie points were rejected; neighbours err in random directions, as mismatches do. Check "
        "tie points have residuals of {error:.2f} px",
        "check for repeated patterns and noise, or supply matches (--matches)"),
    "place": Cause("doubtful", "inconsistent rows or columns",
        "in {place} {what}", "check for {cause}"),
    "gap": Cause("doubtful", "rows or columns with few tie points",
        "{place} have {found} of about {due} tie points expected from their detail, so an error there would not show",
        "check for clouds, water, change there, or a jump in the image"),
    "beside": Cause("doubtful", "connected to a contradicting image",
        "check tie points have residuals of {error:.2f} px; most of them are seen in {other}, too, which contradicts "
        "the other images",
        "check that image first"),
    "held_out": Cause("doubtful", "large residuals of check tie points",
        "check tie points have residuals of {error:.2f} px, {noise:.1f} times the accuracy that the matcher states",
        "check for wrong matches, moving objects, or camera errors that the model cannot represent"),
    "along_lines": Cause("doubtful", "heights behind a jump",
        "heights of {place} may be off by {metres}: no image shows their displacement along the epipolar lines",
        "add an image from another direction, or a DEM (--dem)"),
    "follows_more": Cause("doubtful", "one RPC is not enough",
        "its corrected camera includes {follows}, and one RPC misses it by {left:.2f} px (RMS; {most:.2f} px at most)",
        "use its grids ({image}_grid.tif)"),
    "disagrees": Cause("doubtful", "cameras disagree",
        "tie points have residuals of {error:.2f} px", "adjust the cameras"),
    "left": Cause("doubtful", "large residuals",
        "tie points keep residuals of {error:.2f} px", "check for wrong matches and moving objects"),
    "unseen": Cause("doubtful", "tie points not projectable",
        "its camera cannot intersect or project its own tie points",
        _ITS_RPC),
    "moving_objects": Cause("doubtful", "tie points move",
        "{share:.0f} % of its tie points move together and were excluded",
        "check that the others lie on stationary ground"),
}  # fmt: skip
"""Cause -> its reservation, the worst first. A test checks that flags in a remedy are those of `barpc adjust`."""


def enu(shift: Sequence[float] | Array) -> str:
    """Return a shift (3,) east, north, up [m] in words."""
    return ", ".join(f"{s:+.2f} m {word}" for s, word in zip(shift, ("east", "north", "up"), strict=True))


def medians(values: Array, group: IntArray, num: int) -> Array:
    """Return the median (num,) of each group of values (n,); NaN without any."""
    count, ordered = np.bincount(group, minlength=num), values[np.lexsort((values, group))]
    first, some = np.cumsum(count) - count, np.flatnonzero(count)
    middle = first[some, None] + (count[some, None] - np.array([1, 0])) // 2  # the two of an even number
    out = np.full(num, np.nan)
    out[some] = ordered[middle].mean(axis=1)
    return out
