"""Verdicts in plain words: of each image, of the block, of what the images cannot tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.ba import Adjustment, check_residuals
from barpc.geodesy import Array
from barpc.report.records import plain
from barpc.report.run import Run
from barpc.report.summary import STATUS_WORDS, Summary, ViewEntry, measure, metres

GOOD_RMSE = 0.5
"""A view whose tie points are left with more than this [px] is called doubtful."""
FEW_OBSERVATIONS = 30
"""A view with fewer is called weakly tied, unless control points hold it."""
ENOUGH_GCPS = 3
"""Control points that hold a view without any tie point."""
MANY_REJECTED = 0.3
"""A view that lost a larger share of its observations is called doubtful."""

SMOOTH_LEFT = 0.06
"""A view whose residuals hold more than this [px] that is no scatter is called doubtful."""
PRIOR_WIDENED = 2.0
"""Cameras that are farther off than stated by more than this factor need a look."""
NOISE_LIMIT = 2.5
"""Tie points that scatter by more than so many times what the matcher states need a look."""
MOVED = 3.0
"""A scene that moved by more than so many of its own standard deviations needs a look."""

GOOD = {"adjust": "adjusted", "check": "consistent", "match": "tied"}
"""Kind of a run -> the status of a view without reservation."""
_ALL_WELL = {
    "adjust": "All {} images are adjusted",
    "check": "The cameras of all {} images agree",
    "match": "All {} images are tied together",
}
_LISTED = 10  # names in a sentence
_CONTROL_WORDS = {
    "rejected": "{} contradicted by the rest, not used: check coordinates, axes and image positions",
    "contradicts": "{} off by more than 4 standard deviations, used all the same: the stated accuracies are too good, "
    "or more than one is wrong",
}


def view_status(view: ViewEntry, run: Run) -> dict[str, str]:
    """The verdict on a view: a word of `STATUS_WORDS`, and what to do (empty when all is well)."""
    for status, advice in (_failure(view, run), _weakness(view), _doubt(view, run)):
        if advice:
            return {"status": status, "advice": advice}
    return {"status": GOOD[run.kind], "advice": ""}


def _failure(view: ViewEntry, run: Run) -> tuple[str, str]:
    tolerance = getattr(getattr(run.options, "fit", None), "tolerance", np.inf)
    if run.adjustment is not None and view.name in run.adjustment.left_out:
        return "failed", "not tied to the other images: its camera was left as it was"
    if view.fit is not None and not max(map(_known, view.fit.max_px)) <= tolerance:
        return (
            "failed",
            f"one RPC cannot hold the corrected camera to {tolerance:g} px: lower --drift or the range",
        )
    return "failed", ""


def _weakness(view: ViewEntry) -> tuple[str, str]:
    few = view.num_observations
    if few >= FEW_OBSERVATIONS or view.num_gcps >= ENOUGH_GCPS:
        return "weak", ""
    return "weak", f"{f'only {few}' if few else 'no'} tie points: check overlap, clouds and dates"


def _doubt(view: ViewEntry, run: Run) -> tuple[str, str]:
    if run.kind == "match":  # how well cameras agree is not what was asked
        return "doubtful", ""
    if view.name in run.copies:
        return "doubtful", f"shows the same pixels as {run.copies[view.name]}: give each image once"
    if run.adjustment is not None and (odd := _oddity(view.name, run.adjustment)):
        return "doubtful", odd
    if run.adjustment is not None and (left := _left(view.name, run.adjustment)):
        return "doubtful", left
    error = _known(view.rmse_after if run.kind == "adjust" else view.rmse_before)
    if not error <= GOOD_RMSE and view.num_observations:
        if run.kind == "check":
            return "doubtful", f"tie points disagree by {error:.2f} px: adjust the cameras"
        return (
            "doubtful",
            f"tie points are left with {error:.2f} px: look for wrong matches and moving things",
        )
    lost = view.num_rejected / max(view.num_rejected + view.num_observations, 1)
    if lost > MANY_REJECTED:
        return (
            "doubtful",
            f"{100 * lost:.0f} % of its tie points were rejected, scattered around what is smooth: look for clouds, "
            "water, change",
        )
    return "doubtful", ""


def _oddity(name: str, adjustment: Adjustment) -> str:
    """What is wrong with a view beside the others: its RPC, or something smooth that no correction follows."""
    i, prior, smooth = adjustment.names.index(name), adjustment.prior, adjustment.smooth
    if prior.odd[i]:
        others = [
            other for other, odd in zip(adjustment.names, prior.odd, strict=True) if odd and other != name
        ]
        either = f" (or that of {_listed(others)}: the tie points cannot tell)" if others else ""
        return (
            f"its RPC is {prior.scale[i]:.0f} times farther off than stated, beside the other images{either}: check "
            "that it belongs to this image"
        )
    if smooth.found(SMOOTH_LEFT)[i] or smooth.shared[i] > SMOOTH_LEFT:
        along = "along the rows" if smooth.by_row[i] > 0.5 else "over the image"
        why = "attitude jitter, optics, or steps between detectors, which one RPC does not follow"
        if adjustment.options.drift == 0:
            why = "a drift was not allowed (--drift 0)"
        return (
            f"an error of {max(smooth.rms[i], smooth.shared[i]):.2f} px that changes {along} is left: {why}"
        )
    return ""


def _left(name: str, adjustment: Adjustment) -> str:
    """What tie points say that took no part: the others were chosen to agree."""
    i = adjustment.names.index(name)
    noise, error = adjustment.held_out_noise[i], adjustment.held_out_rms[i]
    if not noise > NOISE_LIMIT:
        return ""
    return (
        f"tie points that took no part are left with {error:.2f} px, {noise:.1f} times what the matcher states: "
        "look for wrong matches, moving things, or errors that these unknowns cannot follow"
    )


def _block_reasons(run: Run) -> list[str]:
    """What the adjustment says of itself that does not fit: priors, noise, the scene's move."""
    if run.adjustment is None or not len(run.tracks):
        return []
    prior, gauge, noise = run.adjustment.prior, run.adjustment.gauge, run.adjustment.noise
    out = []
    common = float(np.min(prior.scale)) if len(prior.scale) else 1.0
    if common > PRIOR_WIDENED:
        out.append(
            f"The cameras are {common:.1f} times farther off than stated: their standard deviations were widened, and "
            "what is known of the scene's place with them."
        )
    if (in_space := run.adjustment.in_space_rms) is not None:
        tilts = ", ".join(metres(s) for s in run.adjustment.gauge.motion_sigma[3:5])
        out.append(
            f"Rotations and translations leave {in_space:.2f} px of tie points that took no part; an affine in each "
            f"image leaves {_median(run.adjustment.held_out_rms):.2f} px and was taken: images that were turned, "
            "resampled or cropped otherwise than their RPCs say, or RPCs of other images. Its tilts are known to "
            f"{tilts} (east, north) only."
        )
    names = run.adjustment.names
    for group in run.adjustment.two_groups:
        i, j = group.views
        if not (_oddity(names[i], run.adjustment) or _oddity(names[j], run.adjustment)):
            out.append(
                f"Tie points of {names[i]} and {names[j]} fall into two groups, {100 * group.share:.0f} % lying "
                f"{group.apart:.2f} px from the others: there are two solutions, and this is the one between them. "
                "Look for a moving cloud or a repeated pattern, or add an image."
            )
    if noise > NOISE_LIMIT:
        out.append(
            f"Tie points scatter {noise:.1f} times as much as stated: wrong matches, or errors that these unknowns "
            "cannot follow."
        )
    with np.errstate(all="ignore"):
        moved = np.abs(gauge.shift) / gauge.sigma
    if _place_is_free(run) and (moved[np.isfinite(moved)] > MOVED).any():
        out.append(
            f"The scene moved by {_enu(gauge.shift)}, more than {MOVED:g} standard deviations: something is not as "
            "stated; control points or a DEM would tell."
        )
    return out


def _place_is_free(run: Run) -> bool:
    """Whether nothing but the cameras' priors holds the scene's place: control moves it as far as it must."""
    given = [getattr(run.options, name, None) for name in ("dem", "fixed_run")]
    assert run.adjustment is not None
    return run.gcps is None and not run.adjustment.options.fixed and not any(given)


def block_verdict(run: Run, views: Sequence[ViewEntry]) -> dict[str, Any]:
    """The verdict on the whole: `status`, a `headline`, `lines`, and those of them that are `reasons`.

    The one rule of what passes: `status` is "good" when no image, no control point and no file has a reservation;
    "bad" when an image was not adjusted or a file left out; else "look". What is not good ends with exit code 3.
    """
    bad = [view for view in views if view.status == "failed"]
    look = [view for view in views if view.advice and view not in bad]
    reasons = [f"{view.name}: {STATUS_WORDS[view.status]}: {view.advice}." for view in bad + look]
    reasons += [f"{path} was left out: {reason}" for path, reason in run.left_out]
    whole, points = _block_reasons(run), _control_reasons(run)
    control = whole + points
    lines = {"adjust": _adjusted_lines, "check": _checked_lines, "match": _matched_lines}[run.kind](
        run, views
    )
    num_bad = len(bad) + len(run.left_out)
    return {
        "status": "bad" if num_bad else "look" if look or control else "good",
        "headline": _headline(
            run,
            len(views),
            num_bad,
            len(look),
            "the block needs" if whole else "ground points need" * bool(points),
        ),
        "lines": lines + reasons + control,
        "reasons": reasons + control,
    }


def _headline(run: Run, num: int, bad: int, look: int, more: str) -> str:
    text = _ALL_WELL[run.kind].format(num)
    if bad or look:
        parts = []
        if bad:
            word = "not adjusted" if run.kind == "adjust" else "not usable"
            parts.append(f"{bad} {'image is' if bad == 1 else 'images are'} {word}")
        if look:
            parts.append(f"{look} {'needs' if look == 1 else 'need'} a look")
        text = f"{', '.join(parts)[0].upper()}{', '.join(parts)[1:]} (of {num + len(run.left_out)})"
    return f"{text}; {more} a look." if more else f"{text}."


def _control_reasons(run: Run) -> list[str]:
    """Ground points that were cut, and images that their files name and that are not there."""
    out = []
    tested = None if run.adjustment is None else run.adjustment.control
    if run.gcps is not None and tested is not None:
        for status, words in _CONTROL_WORDS.items():
            names = [
                f"{name} ({metres(float(np.linalg.norm(tested.residual[g])))}, w = {tested.w[g]:.1f})"
                for g, name in enumerate(run.gcps.names)
                if tested.status(g) == status
            ]
            if names:
                out.append(f"{words.format(_count(len(names), 'GCP'))}: {_listed(names)}.")
    for points, what in ((run.gcps, "GCPs"), (run.check_points, "Check points")):
        if points is not None and points.strangers:
            out.append(f"{what} name images that are not in this run: {_listed(points.strangers)}.")
    return out


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{', '.join(names[:_LISTED])}{more}"


def _adjusted_lines(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    assert run.adjustment is not None
    before, after = (
        _median([view.rmse_before for view in views]),
        _median([view.rmse_after for view in views]),
    )
    gauge = run.adjustment.gauge
    lines = [f"Tie points of {len(views)} images agree to {after:.3f} px (before: {before:.3f} px)."]
    if not len(run.tracks):
        lines = ["There are no tie points: the cameras are held by control points alone."]
    drift = run.adjustment.cameras.unknowns.drift
    if run.adjustment.prior.drift_sigma:
        sizes = ", ".join(metres(s) for s in run.adjustment.prior.drift_sigma)
        lines.append(
            f"Rotations change along the rows (drift of degree {drift}; {sizes} at the first and last row)."
        )
    lines.append(f"The scene as a whole moved by {_enu(gauge.shift)}.")
    known = ", ".join(metres(s) for s in gauge.sigma)
    if run.gcps is None:
        lines.append(
            f"Without ground control its place is known to {known} (east, north, up; one sigma) only."
        )
    else:
        is_seen = np.bincount(run.gcps.point, minlength=len(run.gcps.names)) > 0
        tested = run.adjustment.control
        held = int(np.count_nonzero(is_seen if tested is None else is_seen & tested.used))
        lines.append(
            f"With {_count(held, 'GCP')} its place is known to {known} (east, north, up; one sigma)."
        )
    if run.check_points is not None and run.after is not None:
        image, ground = check_residuals(run.after, run.check_points).rms()
        seen = f"{np.hypot(*image):.2f} px in the images"
        if np.isfinite(ground).all():
            seen += f" and {', '.join(metres(r) for r in ground)} on the ground (east, north, up)"
        lines.append(f"{len(run.check_points.names)} check points, not used above, are met to {seen} (RMS).")
    return lines


def _enu(shift: Array) -> str:
    return ", ".join(f"{s:+.2f} m {word}" for s, word in zip(shift, ("east", "north", "up"), strict=True))


def _checked_lines(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    rmse = _median([view.rmse_before for view in views])
    return [f"Tie points of {len(views)} images agree to {rmse:.3f} px as the cameras are."]


def _matched_lines(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    return [f"{run.tracks.num_points} tie points of {len(views)} images, {len(run.tracks)} observations."]


def _median(values: Iterable[float | None]) -> float:
    finite = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.median(finite)) if finite else float("nan")


def _known(value: float | None) -> float:
    return float("nan") if value is None else value


def summarize(run: Run) -> Summary:
    """The summary of a run with the verdict on it; a number that is not finite is None, as a file has it."""
    found = measure(run)
    views = tuple(replace(view, **view_status(view, run)) for view in found.views)  # type: ignore[arg-type]
    block = block_verdict(run, views)
    verdict = {"status": block["status"], "headline": block["headline"], "reasons": block["reasons"]}
    passed = block["status"] == "good"
    whole = replace(found, views=views, verdict=block["lines"], passed=passed, **verdict)
    return Summary.read(plain(whole))
