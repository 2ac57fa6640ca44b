"""Images to tracks: windowed reading, detection, matching, linking.

`find_tracks` runs all stages: `select_pairs`, `detect`, `match`, `link`, `thin`, `refine`.
"""

from barpc.options import TieOptions
from barpc.tie.area import Area, read_area
from barpc.tie.features import Keypoints
from barpc.tie.find import TieResult, detect, find_tracks, match, require_matches
from barpc.tie.matcher import Matches
from barpc.tie.matching import PairReport, match_pair
from barpc.tie.pairs import Pair, select_pairs
from barpc.tie.tracks import common_tracks, link, refine, thin

__all__ = [
    "Area",
    "Keypoints",
    "Matches",
    "Pair",
    "PairReport",
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
