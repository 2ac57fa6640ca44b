"""The decisions of a run in sentences: matchers, camera model, priors, rejection."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from barpc.base.statistics import LARGEST
from barpc.report.records import flat_options
from barpc.report.summary import Summary
from barpc.report.summary.block import JustificationEntry, SceneEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import CorrectionEntry, ViewEntry
from barpc.report.summary.words import counted, known, metres, two_digits

_UNEXPLAINED = "systematic", "held_out", "wrong_matches", "beside", "contradicted", "rejected", "left", "place"
"""Causes of a reservation whose residuals nothing explains."""
_WIDENED = 1.005  # factor that reads as more than 1.0


def decisions(summary: Summary) -> list[str]:
    """Return the decisions of a run, in the order in which they are made."""
    options, scene, views = flat_options(summary.options or {}), summary.scene, summary.views
    found = [*_matched(summary.pairs, options.get("tie.matcher"))]
    if scene is not None:
        if scene.model:
            found.append(f"Each camera is corrected by {scene.model.replace('+', ' and ')}.")
        found += [*_drift(scene, options.get("adjust.drift")), *_added_images(scene, views)]
        found += [*_jitter(scene, views), *_priors(scene, views), *_rejected(scene, views)]
    if (test := summary.control_test) is not None:
        found.append(
            f"Of {counted(test.num, 'residual')} of control points in the images, {test.num_beyond} "
            f"{'has' if test.num_beyond == 1 else 'have'} Baarda's w above {test.critical:.3g} in column or row "
            f"({two_digits(test.expected)} expected by chance). The largest w is {known(test.largest_w):.1f} "
            f"({test.point} in {test.image})."
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
        yield f"The matcher estimates that at most {100 * share:.2g} % of a pair's matches are false ({a} - {b})."
    if any(pair.chosen_by not in (None, "overlap and angle") for pair in tied):
        yield f"Pairs by selection criterion: {_tally((pair.chosen_by for pair in tied), ' ')}."
    if pairs and not tied:
        yield "Tie points were given: nothing was matched."


def _tally(values: Iterable[str | None], between: str) -> str:
    """Return how often which value stands, the most frequent first."""
    return ", ".join(f"{num}{between}{value}" for value, num in Counter(filter(None, values)).most_common())


def _corrections(views: Sequence[ViewEntry]) -> list[CorrectionEntry]:
    return [view.correction for view in views if view.correction is not None]


def _added_images(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield why no parameters were added to the model."""
    if scene.explanations or scene.held_out_places is None:  # None: of an earlier release
        return
    if sum(len(one.unknowns) for one in _corrections(views)) > LARGEST:
        yield f"No additional parameters were tested: the block has more than {LARGEST:,} unknowns."
    elif not any(view.num_observations for view in views):
        return
    elif scene.left or scene.held_out_places or any(view.cause in _UNEXPLAINED for view in views):
        yield "None of the additional parameters that were tested explains the inconsistent residuals."
    else:
        yield "No further parameters of the images were selected."


def _left(one: JustificationEntry) -> str:
    """Return the residuals that a simpler model left."""
    text = f"systematic residuals of {known(one.systematic_px):.2f} px in {one.image}"
    if not one.neighbour_correlated_px:
        return text
    return f"{text}, and {one.neighbour_correlated_px:.2f} px correlated between neighbours"


def _drift(scene: SceneEntry, asked: object) -> Iterator[str]:
    """Yield the degree of the attitude drift, and the residuals of a lower one; `asked`: the option."""
    degree, words = scene.drift_degree, "The attitude drift is estimated as a polynomial of the row, of degree"
    if asked is not None:
        yield f"The degree of the attitude drift, {degree}, was set by an option."
    elif not degree:
        yield "No attitude drift was estimated: the model has no rotation, or the earlier run had no drift."
    elif None in scene.drift_sigma_m:
        yield f"{words} {degree}, as in the earlier run."
    else:
        sigma = ", ".join(metres(known(one)) for one in scene.drift_sigma_m) + " (by degree)" * (degree > 1)
        yield f"{words} {degree}. The prior sigma of the drift is {sigma} on the ground, at the first and last row."
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
    """Yield which accuracies of cameras were widened, as the corrections exceed them."""
    if scene.prior_ratio is None:
        return
    if widened := [(by, one.name) for one in views if (by := one.prior_scale or 0.0) > _WIDENED]:
        (least, _), (most, name) = min(widened), max(widened)
        named = len(widened) == 1 or most > _WIDENED * least  # the priors of two images are widened alike
        times = f"by up to {most:.1f} ({name})" if named else f"by {most:.1f}"
        yield (
            "The corrections are larger than the prior sigmas of the cameras allow. The prior sigmas of position and "
            f"attitude of {counted(len(widened), 'image')} were multiplied {times}."
        )
    if (scene.prior_shared or 1.0) > _WIDENED:
        yield f"The prior sigmas of an error common to all images were multiplied by {scene.prior_shared:.1f}."


def _rejected(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield how many observations have which use, and whether check tie points are met everywhere."""
    used, cut, moving = (
        sum(getattr(view, f"num_{name}") for view in views) for name in ("observations", "rejected", "moving")
    )
    if used + scene.num_held_out + cut + moving:
        counts = f"{used} used, {scene.num_held_out} check (independent of the adjustment)"
        counts += f", {cut} rejected (false or imprecise)" + f", {moving} excluded (they move together)" * bool(moving)
        yield f"Observations of tie points: {counts}."
    untested = any(view.num_observations and view.held_out_px is None for view in views)
    doubted = untested or any(view.cause in _UNEXPLAINED for view in views)
    if scene.num_held_out and scene.held_out_places == () and not doubted:
        yield "No part of an image has significantly larger residuals of check tie points than the rest."
