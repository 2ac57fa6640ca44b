"""Images to tracks: windowed reading, detection, matching, linking.

`find_tracks` runs all stages: `select_pairs`, `detect`, `match`, `link`, `thin`, `refine`.
"""

from barpc.options import TieOptions
from barpc.tie.choice import select_pairs
from barpc.tie.features import Keypoints, detect
from barpc.tie.matcher import Matches
from barpc.tie.matching import PairReport, match, match_pair
from barpc.tie.pairs import Area, Pair, read_area
from barpc.tie.reference import Registration
from barpc.tie.register import refine
from barpc.tie.tracks import TieResult, common_tracks, find_tracks, link, require_matches, thin

__all__ = [
    "Area",
    "Keypoints",
    "Matches",
    "Pair",
    "PairReport",
    "Registration",
    "TieOptions",
    "TieResult",
    "common_tracks",
    "detect",
    "find_tracks",
    "link",
    "match",
    "match_pair",
    "read_area",
    "refine",
    "require_matches",
    "select_pairs",
    "thin",
]
