"""Images to tracks: windowed reading, detection, matching, linking.

`find_tracks` runs all stages: `select_pairs`, `detect`, `match_pairs`, `link`, `thin`, `refine`.
"""

from barpc.base.options import TieOptions
from barpc.tie.matchers.features import Keypoints, detect
from barpc.tie.matchers.matcher import Matches
from barpc.tie.matchers.matching import match_pair, match_pairs
from barpc.tie.matchers.report import PairReport, require_matches
from barpc.tie.pairing.area import Area, read_area
from barpc.tie.pairing.overlaps import Pair, Scope, select_pairs
from barpc.tie.patches.register import refine
from barpc.tie.reference import ReferenceControl
from barpc.tie.tracks import TieResult, common_tracks, find_tracks, link, thin

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
    "common_tracks",
    "detect",
    "find_tracks",
    "link",
    "match_pair",
    "match_pairs",
    "read_area",
    "refine",
    "require_matches",
    "select_pairs",
    "thin",
]
