"""Images to tracks: windowed reading, detection, matching, linking.

`find_tracks` runs all stages: `possible_pairs`, `locate`, `match_pairs`, `link`, `thin`, `refine`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from barpc.base import used_later
from barpc.base.options import TieOptions

if TYPE_CHECKING:
    from barpc.tie.linking import link, thin
    from barpc.tie.matchers.features import Keypoints
    from barpc.tie.matchers.matcher import Matches
    from barpc.tie.matchers.matching import match_pairs
    from barpc.tie.matchers.report import PairReport
    from barpc.tie.pairing.area import Area, read_area
    from barpc.tie.pairing.overlaps import Pair, Scope
    from barpc.tie.patches.links import refine
    from barpc.tie.reference import ReferenceControl
    from barpc.tie.tracks import TieResult, find_tracks

__all__ = [
    "Area",
    "Keypoints",
    "Matches",
    "Pair",
    "PairReport",
    "ReferenceControl",
    "Scope",
    "TieOptions",
    "TieResult",
    "find_tracks",
    "link",
    "match_pairs",
    "read_area",
    "refine",
    "thin",
]
__getattr__ = used_later(
    __name__,
    {
        "Keypoints": "barpc.tie.matchers.features",
        "Matches": "barpc.tie.matchers.matcher",
        "match_pairs": "barpc.tie.matchers.matching",
        "PairReport": "barpc.tie.matchers.report",
        **dict.fromkeys(("Area", "read_area"), "barpc.tie.pairing.area"),
        **dict.fromkeys(("Pair", "Scope"), "barpc.tie.pairing.overlaps"),
        "refine": "barpc.tie.patches.links",
        "ReferenceControl": "barpc.tie.reference",
        **dict.fromkeys(("TieResult", "find_tracks", "link", "thin"), "barpc.tie.tracks"),
    },
)
