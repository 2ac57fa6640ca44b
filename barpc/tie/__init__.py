"""Images to tracks: windowed reading, detection, matching, linking.

`find_tracks` runs all stages; `select_pairs`, `detect`, `match`, `link` and `thin` are the stages.
"""

from barpc.tie.features import Keypoints
from barpc.tie.find import TieResult, detect, find_tracks, match, require_matches
from barpc.tie.link import link, thin
from barpc.tie.matching import Matches, PairReport, match_pair
from barpc.tie.options import TieOptions
from barpc.tie.pairs import Pair, select_pairs

__all__ = [
    "Keypoints",
    "Matches",
    "Pair",
    "PairReport",
    "TieOptions",
    "TieResult",
    "detect",
    "find_tracks",
    "link",
    "match",
    "match_pair",
    "require_matches",
    "select_pairs",
    "thin",
]
