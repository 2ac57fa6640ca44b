"""Sentences of report.html: the answer to each of its questions, and the decisions of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

from barpc.base.errors import listed
from barpc.base.statistics import LARGEST
from barpc.report.ranking import GOOD_RMSE, MIN_PAIR_MATCHES, offset_of
from barpc.report.records import flat_options
from barpc.report.runfiles import ReliefWindow
from barpc.report.summary import Summary
from barpc.report.summary.block import JustificationEntry, SceneEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import CorrectionEntry, ViewEntry
from barpc.report.summary.words import counted, known, metres, two_digits

_UNEXPLAINED = "systematic", "held_out", "wrong_matches", "beside", "contradicted", "rejected", "left", "place"
"""Causes of a reservation whose residuals nothing explains."""
_SIGNIFICANT = 1e-4  # probability of the F test below which systematic residuals are no noise
_WIDENED = 1.005  # factor that reads as more than 1.0
_ROUNDING = 1e-6  # px
MAX_LENGTHS_SAID = 4  # numbers of a sentence; more are a chart
FOOTER = (
    "Residuals are projected minus observed. Altitudes are above the WGS84 ellipsoid. Pixel (0, 0) is the centre of "
    "the first pixel. The numbers of this page are in summary.json and in the folder tables: residuals.csv, "
    "observations.csv, pairs.csv, footprints.geojson."
)


def of_map(by_length: Mapping[int, int] | Mapping[str, int], groups: int, lonely: Sequence[str]) -> str:
    """Return how tie points connect the images; `by_length`: number of images -> tie points seen in that many."""
    tied = "Tie points connect all images."
    if not by_length:
        tied = "There are no tie points in use."
    elif groups > 1:
        tied = f"Tie points connect the images in {groups} separate groups."
    if lonely:
        tied += f" Connected to one other image only: {listed(lonely)}."
    if not by_length or len(by_length) > MAX_LENGTHS_SAID:
        return tied
    (first, most), *rest = by_length.items()
    lengths = [f"{counted(most, 'tie point')} in {first} images", *(f"{num} in {length}" for length, num in rest)]
    return f"{tied} {', '.join(lengths)}."


def of_residuals(marked: Sequence[str], key: str) -> str:
    """Return the images most of whose cells have a significant mean residual, and the key of their maps."""
    random = "Yes: in no image do most cells have a significant mean residual."
    if marked:
        random = f"Not in {listed(marked)}: most cells there have a significant mean residual."
    return f"{random} Colour: size. Thin lines: single residuals. Bold arrows: significant means of cells. {key}"


def of_surface(before: ReliefWindow, after: ReliefWindow) -> str:
    """Return how much of a sample of the surface has heights, and how well these agree."""
    text = (
        f"In a sample of the surface model {100 * before.share:.0f} % of the cells have a height with the delivered "
        f"cameras, {100 * after.share:.0f} % with the corrected ones."
    )
    if before.nmad_m is None or after.nmad_m is None:
        return text
    return f"{text} Heights of different pairs differ by {metres(before.nmad_m)} and {metres(after.nmad_m)} (NMAD)."


def of_pairs(worst: PairEntry, heights: bool) -> str:
    """Return the largest epipolar offset (RMS) [px], the limit of stereo, and whether no pair determines `heights`."""
    fit = "Unknown: no camera of a pair projects the tie points of the other."
    if set(worst.offset_rms) != {None}:
        fit = f"Epipolar offsets are at most {offset_of(worst):.3f} px (RMS; {worst.a} - {worst.b})."
        fit += f" Stereo needs less than {GOOD_RMSE} px."
    enough = f"{MIN_PAIR_MATCHES} matches and a convergence angle that determines heights"
    none = f" No pair of images that passed has {enough}."
    return fit + none * (not heights)


def of_scene(scene: SceneEntry, tied: bool) -> str:
    """Return an introduction to the uncertainty of the scene; `tied`: with tie points."""
    text = "Tie points fix the images relative to each other, not on the Earth. " * tied
    if scene.num_held_in_height:
        held = counted(scene.num_held_in_height, "tie point")
        text += f"The heights of {held} with too small a convergence angle were constrained."
    return text.strip()


def of_files(worst: float | None) -> str:
    """Return the largest error of the fitted RPCs [px]; None where it is not known for every image."""
    exact = "Yes, exactly."
    if worst is None:
        exact = "Not known for every image."
    elif worst > _ROUNDING:
        exact = f"To {worst:.1e} px over each image and its altitude range."
    return f"{exact} The old images still carry the old RPC."


def of_run(summary: Summary) -> str:
    """Return the numbers of images, tie points and observations."""
    counts = len(summary.views), summary.tracks.num_tracks, summary.tracks.num_observations
    text = ", ".join(map(counted, counts, ("image", "tie point", "observation"))) + "."
    if summary.tables.complete:
        return text
    return f"{text} Tables and charts show {summary.tables.num_written_tracks} tie points, sampled evenly."


# --- decisions ----------------------------------------------------------------------------------------------


def decisions(summary: Summary) -> list[str]:
    """Return the decisions of the run: matchers, camera model, priors, rejection."""
    options, scene, views = flat_options(summary.options or {}), summary.scene, summary.views
    found = [*_matched(summary.pairs, options.get("tie.matcher"))]
    if scene is not None:
        if scene.model:
            found.append(f"Each camera is corrected by {scene.model.replace('+', ' and ')}.")
        found += [*_added(scene, views), *_drift(scene, options.get("adjust.drift"))]
        found += [*_jitter(scene, views), *_priors(scene, views), *_rejected(scene, views)]
    if (test := summary.control_test) is not None:
        found.append(
            f"{test.num_beyond} of {counted(test.num, 'residual')} of control points in the images are significant "
            f"({two_digits(test.expected)} expected by chance). The largest is that of {test.point} in {test.image} "
            f"(w = {known(test.largest_w):.1f}; limit: {test.critical:.3g})."
        )
    return found


def _matched(pairs: Sequence[PairEntry], matcher: object) -> Iterator[str]:
    """Yield which matchers matched how many pairs, their false matches, and why pairs were selected."""
    tied = [pair for pair in pairs if pair.tied_by]
    if any(pair.tied_by != matcher for pair in tied):
        by = _tally((pair.tied_by for pair in tied), " by ")
        yield f"Not all pairs were matched by {matcher or 'one matcher'}: {by}."
    if shares := [(pair.decoy_share, pair.a, pair.b) for pair in tied if pair.decoy_share is not None]:
        share, a, b = max(shares)
        yield f"At most {100 * share:.2g} % of a pair's matches are false ({a} - {b})."
    if any(pair.chosen_by not in (None, "overlap and angle") for pair in tied):
        yield f"Pairs by selection criterion: {_tally((pair.chosen_by for pair in tied), ' ')}."
    if pairs and not tied:
        yield "Tie points were given: nothing was matched."


def _tally(values: Iterable[str | None], between: str) -> str:
    """Return how often which value stands, the most frequent first."""
    return ", ".join(f"{num}{between}{value}" for value, num in Counter(filter(None, values)).most_common())


def _corrections(views: Sequence[ViewEntry]) -> list[CorrectionEntry]:
    return [view.correction for view in views if view.correction is not None]


def _added(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield why no parameters were added to the model."""
    if scene.explanations or scene.held_out_places is None:  # None: of an earlier release
        return
    if sum(len(one.unknowns) for one in _corrections(views)) > LARGEST:
        yield f"No additional parameters were tested: the block has more than {LARGEST:,} unknowns."
    elif not any(view.num_observations for view in views):
        return
    elif scene.left or scene.held_out_places or any(view.cause in _UNEXPLAINED for view in views):
        yield "No additional parameters that were tested explain the inconsistent residuals."
    elif more := [view for view in views if known(view.systematic_p) < _SIGNIFICANT]:
        most = max(more, key=lambda view: (view.systematic_px or 0.0, view.name))
        size = two_digits(known(most.systematic_px))
        yield f"No additional parameters were selected. Systematic residuals are at most {size} px ({most.name})."
    elif any(view.systematic_p is None for view in views):
        yield "No additional parameters were selected."
    else:
        yield "No additional parameters were needed: no image has significant systematic residuals."


def _left(one: JustificationEntry) -> str:
    """Return the residuals that a simpler model left."""
    text = f"systematic residuals of {known(one.systematic_px):.2f} px in {one.image}"
    if not one.neighbour_correlated_px:
        return text
    return f"{text}, and {one.neighbour_correlated_px:.2f} px correlated between neighbours"


def _drift(scene: SceneEntry, asked: object) -> Iterator[str]:
    """Yield the degree of the attitude drift, and the residuals of a lower one; `asked`: the option."""
    degree, words = scene.drift_degree, "The attitude may drift along the rows as a polynomial of degree"
    if asked is not None:
        yield f"The degree of the attitude drift, {degree}, was set by an option."
    elif not degree:
        yield "No attitude drift was estimated: the model has no rotation, or the earlier run had no drift."
    elif None in scene.drift_sigma_m:
        yield f"{words} {degree}, as in the earlier run."
    else:
        sigma = ", ".join(metres(known(one)) for one in scene.drift_sigma_m)
        yield f"{words} {degree} (1 sigma on the ground at the first and last row: {sigma})."
        if scene.drift_justification is not None:
            yield f"Degree {degree - 1} left {_left(scene.drift_justification)}."


def _jitter(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the splines and detector steps, and the residuals without them."""
    follow = [
        (one.jitter_px, one.jitter_rows, view.name)
        for view in views
        if (one := view.correction) is not None and one.jitter_px is not None
    ]
    if follow:
        size, rows, name = max(follow, key=lambda one: one[0])
        yield (
            f"Splines with a knot every {known(rows):.0f} rows model attitude jitter in "
            f"{counted(len(follow), 'image')}, up to {size:.2f} px RMS ({name})."
        )
        if scene.jitter_justification:
            yield f"Without splines, {_left(scene.jitter_justification)} remained."
    if steps := [len(one.detectors) for one in _corrections(views) if one.detectors]:
        many = counted(max(steps), "column")
        yield f"Steps between detectors are estimated at up to {many} of {counted(len(steps), 'image')}."


def _priors(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield whether the corrections are within the stated accuracies."""
    if scene.prior_ratio is None:
        return
    if widened := [(one.prior_scale, one.name) for one in views if (one.prior_scale or 0.0) > _WIDENED]:
        most, name = max(widened)
        yield (
            "The corrections exceed the stated accuracies: these were widened in "
            f"{counted(len(widened), 'image')}, at most {most:.1f} times ({name})."
        )
    else:
        yield "The stated accuracies were kept."
    if (scene.prior_shared or 1.0) > _WIDENED:
        yield f"For an error common to all images they were widened {scene.prior_shared:.1f} times."


def _rejected(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield how many observations have which use, and whether check tie points are met everywhere."""
    used, cut, moving = (
        sum(getattr(view, f"num_{name}") for view in views) for name in ("observations", "rejected", "moving")
    )
    if used + scene.num_held_out + cut + moving:
        counts = f"{used} used, {scene.num_held_out} check (independent of the adjustment), {cut} rejected as outliers"
        counts += f", {moving} excluded, as they move together" * bool(moving)
        yield f"Observations of tie points: {counts}."
    untested = any(view.num_observations and view.held_out_px is None for view in views)
    doubted = untested or any(view.cause in _UNEXPLAINED for view in views)
    if scene.num_held_out and scene.held_out_places == () and not doubted:
        yield "Check tie points fit equally well in all parts of every image."
