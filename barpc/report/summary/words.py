"""Types and words that the records of summary.json share, and the one table of what is wrong with an image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from barpc.report.records import Number

STATUS_WORDS = {
    "adjusted": "adjusted",
    "consistent": "consistent",
    "tied": "tied",
    "weak": "weakly tied",
    "doubtful": "doubtful",
    "failed": "not adjusted",
}
"""Status of a view -> what people read, from good to bad."""

Count = Annotated[int, {"minimum": 0}]
Side = Annotated[int, {"minimum": 1}]
Share = Annotated[float, {"minimum": 0, "maximum": 1}]
Pixel = tuple[Number, Number]
Vector = tuple[Number, Number, Number]
ABOVE = "m above the ellipsoid"


def largest(values: Sequence[float | None] | None) -> float | None:
    """Return the largest number; None where one is missing, which may be larger."""
    return None if not values or None in values else max(value for value in values if value is not None)


NAMED = 5
"""Images, points or reasons that one sentence names."""


def counted(number: int, what: str) -> str:
    """A number of things.

    Examples
    --------
    >>> counted(1, "image"), counted(2, "image")
    ('1 image', '2 images')
    """
    return f"{number} {what}{'' if number == 1 else 's'}"


def median(values: Iterable[float | None]) -> float:
    """Return the median of the finite numbers; NaN without any."""
    found = np.array(list(values), dtype=np.float64)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) else float("nan")


def known(value: float | None) -> float:
    """Return a number, NaN where there is none."""
    return float("nan") if value is None else value


def metres(value: float) -> str:
    """Return a length with a unit that keeps it readable.

    Examples
    --------
    >>> metres(3.14159), metres(0.0421), metres(0.00012)
    ('3.1 m', '4.2 cm', '0.1 mm')
    """
    for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        if abs(value) * factor >= 1.0:
            return f"{value * factor:.1f} {unit}"
    return f"{value * 1e3:.1f} mm"


@dataclass(frozen=True)
class Cause:
    """A cause: the verdict it leads to, its name in a few words, its sentence and advice, with figures in braces."""

    status: Literal["failed", "weak", "doubtful"]
    label: str
    sentence: str
    remedy: str = ""

    def advice(self, **figures: object) -> str:
        """Return the sentence with its figures, and what to do."""
        return ": ".join(filter(None, (self.sentence, self.remedy))).format_map(figures)


CAUSES = {
    "no_overlap": Cause("failed", "overlaps no other image",
        "it overlaps no other image as asked, and its camera was left as it was",
        "check its RPC (IMAGE,camera=FILE names another), or lower [tie] min_overlap of a file given with --options"),
    "untied": Cause("failed", "not tied to the others",
        "not tied to the other images{tried}, its camera was left as it was",
        "look for clouds, water and other dates, or give matches of your own (--matches)"),
    "other_rpc": Cause("failed", "RPC not its own",
        "its RPC is not its own: {strangeness}. They were adjusted without it, and its camera was left as it was",
        "check that the RPC belongs to this image (IMAGE,camera=FILE names another)"),
    "contradicts_all": Cause("failed", "contradicts the others",
        "{strangeness}. They were adjusted without it, and its camera was left as it was",
        "check clouds, water and change, and that the RPC belongs to this image (IMAGE,camera=FILE names another)"),
    "one_rpc_misses": Cause("failed", "RPC fit misses its tolerance",
        "one RPC cannot hold the corrected camera to {tolerance:g} px", "lower --drift, or hand its grid on (--grids)"),
    "contradicted": Cause("doubtful", "contradicts the others",
        "{share:.0f} % of its tie points were rejected, as they contradict those of the other images",
        "check that the RPC belongs to this image (IMAGE,camera=FILE names another); look for clouds, water, change"),
    "whole_pixels": Cause("weak", "matched at whole pixels",
        "its tie points were matched at whole pixels: all of them may be off alike by {shared:.1f} px",
        "give ground points, an image of another date, or matches of your own (--matches)"),
    "few": Cause("weak", "few tie points", "only {few} tie points", "check overlap, clouds and dates"),
    "none": Cause("weak", "no tie points", "no tie points", "check overlap, clouds and dates"),
    "few_gcps": Cause("weak", "few GCPs", "it is held by {gcps} alone, in which an error would hardly show",
        "give three or more"),
    "copy": Cause("doubtful", "shown twice", "shows the same pixels as {other}", "give each image once"),
    "apart": Cause("doubtful", "RPC not its own",
        "its RPC is {stated}: {strangeness}. It was adjusted alone, against points of the other images",
        "check that the RPC belongs to this image (IMAGE,camera=FILE names another)"),
    "odd": Cause("doubtful", "RPC farther off than stated",
        "its RPC is {scale:.0f} times farther off than stated, beside the other images{either}",
        "check that it belongs to this image (IMAGE,camera=FILE names another)"),
    "smooth": Cause("doubtful", "an error that changes over it",
        "an error of {size:.2f} px that changes {along} is left: {why}"),
    "rejected": Cause("doubtful", "many tie points rejected",
        "{share:.0f} % of its tie points were rejected, neighbours in the same direction{place}",
        "look for clouds, water, change"),
    "wrong_matches": Cause("doubtful", "wrong matches",
        "{share:.0f} % of its tie points were rejected, neighbours in any direction, as wrong matches are, and those "
        "that took no part are left with {error:.2f} px",
        "look for repeated patterns and noise, or give matches of your own (--matches)"),
    "place": Cause("doubtful", "a part of it lies off",
        "{place} stand out, {what}", "look for {cause}"),
    "gap": Cause("doubtful", "a part of it without tie points",
        "{place} have {found} of some {due} tie points that their detail lets expect, so an error there would not show",
        "look for clouds, water, change there, or a jump of the image"),
    "beside": Cause("doubtful", "beside an image that contradicts",
        "tie points that took no part are left with {error:.2f} px, and most of these are seen in {other} too, whose "
        "tie points contradict the others",
        "look at that image first"),
    "held_out": Cause("doubtful", "tie points that took no part lie off",
        "tie points that took no part are left with {error:.2f} px, {noise:.1f} times what the matcher states",
        "look for wrong matches, moving things, or errors that these unknowns cannot follow"),
    "follows_more": Cause("doubtful", "more than one RPC holds",
        "its corrected camera follows {follows}, of which one RPC leaves {left:.2f} px (RMS; {most:.2f} px at most)",
        "use its grids ({image}_grid.tif), or --resample"),
    "disagrees": Cause("doubtful", "cameras disagree", "tie points disagree by {error:.2f} px", "adjust the cameras"),
    "left": Cause("doubtful", "large residuals",
        "tie points are left with {error:.2f} px", "look for wrong matches and moving things"),
    "unseen": Cause("doubtful", "does not see its tie points",
        "its camera does not see its own tie points where they are",
        "check that the RPC belongs to this image (IMAGE,camera=FILE names another)"),
    "moving": Cause("doubtful", "tie points move",
        "{share:.0f} % of its tie points move together and took no part",
        "check that the others are the ground that stands still"),
}  # fmt: skip
"""Cause -> its words, the worst first. A flag in a remedy is one of `barpc adjust`, as a test asks its command line."""
