"""The sentences of a verdict, each on both sides of what decides it, with its figures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.constraints.ground import TerrainTest
from barpc.ba.control.agreement import Agreement
from barpc.ba.control.snooping import ControlTest
from barpc.ba.robust.consensus import TwoGroups
from barpc.ba.robust.systematic_residuals import SmoothTest
from barpc.ba.terms.term import Finding
from barpc.base.options import FitOptions, RunOptions
from barpc.report import quality_checks
from barpc.report import verdict as verdicts
from barpc.report.constraints import held_lines
from barpc.report.measures.block import explanations
from barpc.report.outcome import MANY_REJECTED, Added, Run
from barpc.report.quality_checks import view_status
from barpc.report.summary.views import FitEntry
from barpc.report.summary.words import enu, metres
from barpc.report.verdict import block_verdict
from barpc.scene import Tracks
from barpc.tie.detail import Gap
from barpc.tie.reference import PEAK, ReferenceControl, ViewMatch
from tests.rpcio.conftest import make_rpc

from .made import a_correction, a_view

NAMES = ("A", "B", "C")
NO_NUMBER = float("nan")


def adjusted(**fields: Any) -> Any:
    """An adjustment of three images that nothing is to be said of."""
    usual = {
        "left_out": (), "names": NAMES, "noise": 1.0, "in_space_rms": None, "two_groups": (), "control": None,
        "deformed": None, "unseen": None, "findings": (), "left": (), "alike": np.full(3, 9.0),
        "reference_inlier": np.zeros(0, bool),
        "prior": a_prior(),
        "smooth": SmoothTest(np.zeros(3), np.ones(3), np.full(3, NO_NUMBER), np.zeros(3)),
        "held_out_noise": np.ones(3), "held_out_rms": np.full(3, 0.2), "held": np.zeros(9, bool), "terrain": None,
        "options": SimpleNamespace(drift=None, fixed=(), min_convergence=1.0, dem_sigma=2.0, sigma_attitude=7.5,
                                   sigma_position=7.5),
        "changed": 0.0,
        "gauge": SimpleNamespace(shift=np.array([1.0, -2.0, 3.0]), sigma=np.array([1.0, 2.0, 0.5]) * 10,
                                 delivered_sigma=np.array([1.0, 2.0, 0.5]) * 10,
                                 motion_sigma=np.array([1.0, 2.0, 3.0, 0.4, 4.5, 6.0, 7.0, 0.8, 4.0, 0.1]),
                                 radius=800.0),
        "apart": None, "altimetry": None, "cameras": SimpleNamespace(unknowns=SimpleNamespace(drift=1)),
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **fields})


def a_prior(scale: Any = (1.0, 1.0, 1.0), odd: Any = (0, 0, 0), perhaps: Any = None) -> Any:
    """Accuracies of three cameras as stated, but for what is given."""
    return SimpleNamespace(odd=np.array(odd, bool), scale=np.array(scale), drift_sigma=(), perhaps_odd=perhaps)


def run_of(adjustment: Any = None, kind: str = "adjust", **fields: Any) -> Any:
    usual = {
        "kind": kind, "adjustment": adjustment or adjusted(), "options": RunOptions(), "reference": None,
        "copies": {}, "number": {name: k for k, name in enumerate(NAMES)}, "gcps": None, "check_points": None,
        "left_out": (), "after": None, "tracks": [0] * 9, "met_worse": (), "matched": (), "beside": {},
        "datums": (), "whole_pixels": frozenset(), "gaps": {}, "known": frozenset(), "added": None,
        "sources": (), "carried": (),
        "views": tuple(SimpleNamespace(name=name, sensor=make_rpc()) for name in NAMES),
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **fields})


def views(**fields: Any) -> list[Any]:
    return [a_view(name, **fields) for name in NAMES]


def said(run: Any, of: Any = None) -> list[str]:
    return block_verdict(run, of or views())["verdict"]


# --- an image ---------------------------------------------------------------------------------------------


def test_the_figures_that_decide():
    found = (
        quality_checks.GOOD_RMSE,
        quality_checks.MIN_TIE_POINTS,
        quality_checks.ENOUGH_GCPS,
        MANY_REJECTED,
    )
    assert found == (0.5, 30, 3, 0.3)
    found = (quality_checks.SMOOTH_LEFT, verdicts.PRIOR_WIDENED, verdicts.NOISE_LIMIT, verdicts.SURELY)
    assert found == (0.06, 2.0, 2.5, 3.0)


def test_an_image_of_which_all_is_well_has_no_advice():
    assert view_status(a_view(), run_of()) == {"status": "adjusted", "advice": "", "cause": None}


@pytest.mark.parametrize(
    ("fields", "status"),
    [
        ({"rmse_after": 0.5}, "adjusted"),
        ({"rmse_after": 0.51}, "doubtful"),
        ({"rmse_after": None}, "doubtful"),
        ({"rmse_after": 0.2, "rmse_before": 9.0}, "adjusted"),
        ({"num_observations": 30}, "adjusted"),
        ({"num_observations": 29}, "weak"),
        ({"num_observations": 29, "num_gcps": 2}, "weak"),
        ({"num_observations": 29, "num_gcps": 3}, "adjusted"),
        ({"num_observations": 0, "num_gcps": 3, "rmse_after": None}, "adjusted"),  # nothing to be doubted
        ({"num_observations": 70, "num_rejected": 30}, "adjusted"),
        ({"num_observations": 70, "num_rejected": 31}, "doubtful"),
    ],
)
def test_an_image_is_judged_at_its_limits(fields, status):
    assert view_status(a_view(**fields), run_of())["status"] == status


def test_wrong_matches_that_lie_anywhere_are_told_and_need_no_look():
    run = run_of(adjusted(alike=np.array([5.0, 5.1, -1.0])))
    lines = said(run, [a_view(name, num_observations=60, num_rejected=40) for name in NAMES])
    told = "More than 30 % of the tie points of A, C were rejected; neighbours err in random directions, "
    assert told + "but in B in the same direction." in lines
    calm = run_of(adjusted(alike=np.array([5.0, -np.inf, -1.0])))
    few = {"A": 40, "B": 2, "C": 40}
    lines = said(calm, [a_view(name, num_observations=60, num_rejected=few[name]) for name in NAMES])
    assert told + "as mismatches do." in lines
    lost = {"num_observations": 60, "num_rejected": 40}
    assert [view_status(a_view(name, **lost), run)["status"] for name in NAMES] == ["adjusted", "doubtful", "adjusted"]
    assert not any("in random directions" in line for line in said(run_of(adjusted(alike=np.full(3, 5.1)))))
    assert not any("in random directions" in line for line in said(run))  # few were rejected
    untested = run_of(adjusted(alike=np.full(3, -np.inf)))  # as those of a view that the others were adjusted without
    assert not any("in random directions" in line for line in said(untested, [a_view(name, **lost) for name in NAMES]))


def test_what_is_advised_has_its_figures():
    def advice(run=None, **fields):
        return view_status(a_view(**fields), run or run_of())["advice"]

    assert advice(num_observations=5) == "Only 5 tie points. Check overlap, clouds and dates"
    assert advice(num_observations=0) == "No tie points. Check overlap, clouds and dates"
    few = a_view(num_observations=5)
    told = replace(few, **view_status(few, run_of())).reservation  # type: ignore[arg-type]
    assert told == "A: weakly connected. Only 5 tie points. Check overlap, clouds and dates."
    assert advice(rmse_after=0.72).startswith("Tie points keep residuals of 0.72 px. Check for wrong matches")
    lost = advice(num_observations=60, num_rejected=40)
    assert lost.startswith("40 % of its tie points were rejected")
    anywhere = run_of(adjusted(alike=np.array([5.0, 9.0, 9.0])))
    assert advice(anywhere, num_observations=60, num_rejected=40) == ""
    check = run_of(kind="check", adjustment=None)
    assert advice(check, rmse_before=0.72) == "Tie points have residuals of 0.72 px. Adjust the cameras"
    assert advice(check, rmse_before=0.5, rmse_after=9.0) == ""
    assert advice(run_of(kind="match"), rmse_before=9.0, rmse_after=9.0, num_rejected=999) == ""
    assert advice(run_of(kind="match"), num_observations=5).startswith("Only 5")
    lacking = run_of(kind="match", gaps={0: Gap(1, 40.0, 157.0, 1, 216)})
    assert advice(lacking) == (
        "Rows 40-157 have 1 of about 216 tie points expected from their detail, so an error there would not show. "
        "Check for clouds, water, change there, or a jump in the image"
    )
    assert view_status(a_view("B"), lacking)["advice"] == ""
    copies = {"A": "B, moved by 1 columns and 2 rows"}
    assert (
        advice(run_of(copies=copies))
        == "Shows the same pixels as B, moved by 1 columns and 2 rows. Give each image once"
    )
    assert view_status(a_view("B"), run_of(copies=copies))["advice"] == ""
    outside = run_of(adjusted(left_out=("A",)))
    assert view_status(a_view("A"), outside)["status"] == "failed"
    assert view_status(a_view("B"), outside)["status"] == "adjusted"


def test_few_tie_points_do_where_a_reference_holds_the_very_image():
    def status(points: int, name: str = "A") -> str:
        found = ReferenceControl(None, (ViewMatch(name, 9.0, (0.0, 0.0), points=points),), 1.0, 1.0)
        return view_status(a_view(num_observations=3), run_of(reference=found))["status"]

    assert (status(4), status(0), status(4, "B")) == ("adjusted", "weak", "weak")


def a_fit(largest: float | None, rmse: float = 0.0) -> FitEntry:
    return FitEntry((rmse, 0.0), (0.0, largest), 0.5, 0.0, 1.0, "lstsq", 9)


@pytest.mark.parametrize(
    ("largest", "options", "status"),
    [
        (0.01, {}, "adjusted"),
        (0.011, {}, "failed"),
        (None, {}, "failed"),
        (0.011, {"grids": True}, "adjusted"),
        (0.011, {"fit": FitOptions(tolerance=0.011)}, "adjusted"),
    ],
)
def test_an_rpc_is_to_hold_its_camera_to_the_tolerance(largest, options, status):
    run = run_of(options=RunOptions(**options))
    found = view_status(a_view(fit=a_fit(largest)), run)
    assert found["status"] == status
    if status == "failed":
        assert (
            found["advice"]
            == "One RPC does not fit the corrected camera to 0.01 px. Lower --drift, or use its grid (--grids)"
        )


@pytest.mark.parametrize("more", ["jitter_px", "detector_px", "step_px", "sinusoid_px"])
@pytest.mark.parametrize(
    ("left", "most", "options", "doubted"),
    [(0.06, 0.15, {}, False), (0.06, 0.16, {}, True), (0.07, 0.15, {}, True), (0.07, 0.25, {"grids": True}, False)],
)
def test_a_camera_that_follows_jitter_needs_more_than_one_rpc(more, left, most, options, doubted):
    run = run_of(options=RunOptions(**options))
    waving = a_view(fit=a_fit(most, left), correction=a_correction(**{more: 0.3}))
    found = view_status(waving, run)
    assert found["status"] == ("doubtful" if doubted else "adjusted")
    assert (
        f"one RPC misses it by {left:.2f} px (RMS; {most:.2f} px at most). Use its grids" in found["advice"]
    ) == doubted
    assert view_status(replace(waving, fit=None), run)["advice"] == ""
    calm = replace(waving, correction=a_correction(**{more: 0.0}))
    assert view_status(calm, run)["advice"].startswith("One RPC does not fit" if not options.get("grids") else "")


def test_an_rpc_that_is_far_off_beside_the_others_is_asked_about():
    def advice(odd: list[int], name: str = "A") -> str:
        prior = a_prior([7.0, 8.0, 9.0], np.isin(np.arange(3), odd))
        return view_status(a_view(name), run_of(adjusted(prior=prior)))["advice"]

    assert advice([0]) == (
        "Its RPC is 7 times less accurate than stated, relative to the other images. Check that the RPC "
        "belongs to this image (IMAGE,camera=FILE names another)"
    )
    assert "(or that of A, C: undetermined by tie points)" in advice([0, 1, 2], "B")
    assert "is 8 times" in advice([0, 1, 2], "B")
    assert advice([0], "B") == ""


@pytest.mark.parametrize(
    ("rms", "p", "shared", "by_row", "drift", "words"),
    [
        (0.06, 1e-9, 0.06, 0.9, None, ""),
        (0.07, 1e-3, 0.0, 0.9, None, ""),
        (0.07, 1e-9, 0.0, 0.51, None, "Systematic residuals of 0.07 px along the rows remain: attitude jitter"),
        (0.07, 1e-9, 0.0, 0.5, 1, "Systematic residuals of 0.07 px over the image remain: attitude jitter"),
        (0.07, 1e-9, 0.12, 0.9, 0, "Systematic residuals of 0.12 px along the rows remain: drift was disabled"),
        (0.01, 1.0, 0.08, NO_NUMBER, None, "Systematic residuals of 0.08 px over the image remain: attitude"),
    ],
)  # fmt: skip
def test_what_is_smooth_and_is_left_is_said(rms, p, shared, by_row, drift, words):
    others = np.array([9.0, 9.0])
    smooth = SmoothTest(*(np.append([value], others) for value in (rms, p, by_row, shared)))
    options = SimpleNamespace(drift=drift)
    found = view_status(a_view(), run_of(adjusted(smooth=smooth, options=options)))["advice"]
    assert found.startswith(words) if words else found == ""


# --- the block --------------------------------------------------------------------------------------------


def reasons(adjustment: Any = None, **fields: Any) -> list[str]:
    return block_verdict(run_of(adjustment, **fields), views())["reasons"]


def test_headlines_count_one_and_many():
    def headline(statuses: list[str], kind: str = "adjust", **fields: Any) -> str:
        of = [
            a_view(name, status=status, advice="x" * (status != "adjusted"))
            for name, status in zip(NAMES, statuses, strict=True)
        ]
        return block_verdict(run_of(kind=kind, **fields), of)["headline"]

    well = ["adjusted"] * 3
    assert headline(well) == "All 3 images are adjusted."
    assert headline(["weak", "adjusted", "adjusted"]) == "1 of 3 images needs review."
    assert headline(["weak", "doubtful", "adjusted"]) == "2 of 3 images need review."
    assert headline(["failed", "doubtful", "adjusted"]) == "1 of 3 images is not adjusted, 1 needs review."
    assert headline(["failed", "failed", "adjusted"]) == "2 of 3 images are not adjusted."
    assert headline(well, left_out=(("x", "y"),)) == "1 of 4 images is not adjusted."
    check = {"kind": "check", "left_out": (("x", "y"), ("z", "y")), "adjustment": None}
    assert headline(well, **check) == "2 of 5 images are not usable."
    noisy, groups = adjusted(noise=2.6), (TwoGroups((1, 2), 0.31, 0.42),)
    for of_block in (noisy, adjusted(in_space_rms=0.95), adjusted(two_groups=groups)):
        assert headline(well, adjustment=of_block) == "All 3 images are adjusted; the block needs review."
    assert headline(["weak", *well[1:]], adjustment=noisy) == "1 of 3 images needs review; the block needs review."
    assert headline(well, kind="check", adjustment=None) == "The cameras of all 3 images agree."


@pytest.mark.parametrize(("scales", "said_of"), [((2.0, 9.0, 9.0), False), ((2.1, 9.0, 9.0), True), ((), False)])
def test_priors_are_doubted_where_every_camera_s_was_widened(scales, said_of):
    found = reasons(adjusted(prior=a_prior(scales)))
    assert bool(found) == said_of
    if said_of:
        assert "The stated sigmas were multiplied by 2.1 or more, and that of the position with them. Check" in found[0]
        assert "two images" not in found[0]
        two = block_verdict(run_of(adjusted(prior=a_prior(scales)), views=run_of().views[:2]), views()[:2])["reasons"]
        assert two[0].split(". ")[2] == "Tie points of two images cannot show which camera is wrong"


def test_with_gcps_the_position_is_not_as_uncertain_as_the_cameras():
    found = adjusted(prior=a_prior([7.0] * 3))
    (alone,), (held,) = reasons(found), reasons(found, gcps=gcps())
    start = "The corrections are larger than the stated accuracies of the cameras allow. The stated sigmas were "
    start += "multiplied by 7.0"
    assert alone.startswith(f"{start}, and that of the position with them. ")
    assert alone.endswith(", or add GCPs or a DEM.")
    assert held == f"{start}. Check the RPCs and the stated accuracies."


def test_an_image_that_alone_explains_what_all_may_is_named():
    (line,) = reasons(adjusted(prior=a_prior([7.0] * 3, perhaps=np.array([False, True, False]))))
    alone = " Errors of B alone explain the corrections about as well."
    assert f"{alone} Check the RPCs and the stated accuracies, first of B, or add GCPs" in line


def test_an_accuracy_that_nobody_stated_is_no_reason():
    """The default is no statement: what was off is said with its size, and corrected."""
    nobody = SimpleNamespace(**{**vars(adjusted().options), "sigma_attitude": None, "sigma_position": None})
    off = [a_view(name, gsd_m=0.5, correction=a_correction(center_shift_px=(0.0, 31.0))) for name in NAMES]
    for odd, scale, names in (
        ([0, 0, 0], [2.1, 9.0, 9.0], "A (31 px), B (31 px), C (31 px)"),
        ([0, 1, 0], [1.0, 9.0, 1.0], "B (31 px)"),
    ):
        silent = tuple(SimpleNamespace(name=name, sensor=replace(make_rpc(), err_bias=None)) for name in NAMES)
        run = run_of(adjusted(prior=a_prior(scale, odd), options=nobody), views=silent)
        found = block_verdict(run, off)
        assert found["reasons"] == []
        assert [view_status(view, run)["cause"] for view in off] == [None] * 3
        (line,) = (line for line in found["verdict"] if "pointing" in line)
        assert (
            line == f"Corrections exceed the pointing error of 21 px that is assumed where no file states one: {names}."
        )
        near = [replace(view, correction=a_correction(center_shift_px=(0.0, 21.0))) for view in off]
        assert not any("pointing" in line for line in block_verdict(run, near)["verdict"])
    assert reasons(moved(600.0, options=nobody), views=silent) == []


@pytest.mark.parametrize(("noise", "said_of"), [(2.5, False), (2.6, True)])
def test_tie_points_that_scatter_are_said_to(noise, said_of):
    found = reasons(adjusted(noise=noise))
    assert bool(found) == said_of
    if said_of:
        assert found[0].startswith("Tie points scatter 2.6 times as much as stated")
    assert not reasons(adjusted(noise=9.0), tracks=[], gcps=None)


def test_an_affine_in_the_image_says_what_it_was_better_than():
    """Whatever it leaves of heights: images that were resampled, or RPCs of others, need a look."""
    known = {"in_space_rms": 0.95, "held_out_rms": np.array([0.1, 0.3, 0.2])}
    for tilt, bend in ((4.9, 4.9), (5.1, 0.1), (0.1, 5.1)):
        gauge = SimpleNamespace(**vars(adjusted().gauge))
        gauge.motion_sigma = np.array([1.0, 2.0, 5.0, 0.4, tilt, 6.0, 7.0, 0.8, bend, 0.1])
        found = adjusted(**known, gauge=gauge)
        line, shape = [one for one in said(run_of(found)) if "affine" in one or "tilted" in one]
        assert reasons(found) == [line, shape]
        assert line == (
            "Rotations and translations leave 0.950 px at check tie points, an affine transform per image 0.200 px: "
            "the affine is used. This is unusual: check that no image was resampled, and that each RPC belongs to "
            "its image."
        )
        assert shape == (
            f"The scene may be tilted, by 40 cm at its eastern and {metres(tilt)} at its northern edge (800 m out), "
            f"and bent, by {metres(max(0.8, bend))}. Add GCPs or a DEM before using heights."
        )


@pytest.mark.parametrize(("bend", "reserved"), [(4.9, False), (5.1, True)])
def test_a_shape_that_is_less_certain_than_the_position_needs_a_look(bend: float, reserved: bool) -> None:
    """Unless something else than the cameras places the scene: then its own sentences say how well."""
    gauge = SimpleNamespace(**vars(adjusted().gauge))
    gauge.motion_sigma = np.array([1.0, 2.0, 5.0, 0.4, 0.3, 6.0, 7.0, 0.8, bend, 0.1])
    assert any("and bent, by" in one for one in reasons(adjusted(gauge=gauge))) == reserved
    assert not any("and bent, by" in one for one in reasons(adjusted(gauge=gauge, control=control()), gcps=gcps()))


def test_two_groups_are_not_said_again_of_an_odd_image():
    groups = (TwoGroups((0, 2), 0.31, 0.42),)
    (line,) = reasons(adjusted(two_groups=groups))
    assert line.startswith("Tie points of A and C form two groups, 31 % displaced by 0.42 px from the others")
    for odd, told in (([1, 0, 0], 0), ([0, 0, 1], 0), ([0, 1, 0], 1)):
        assert len(reasons(adjusted(two_groups=groups, prior=a_prior(odd=odd)))) == told


def moved(by: float, **fields: Any) -> Any:
    shift, sigma = np.array([0.0, -by, 0.1]), np.array([0.0, 2.0, 1.0])
    gauge = {"shift": shift, "sigma": sigma * 0.1, "delivered_sigma": sigma, "motion_sigma": np.full(10, 0.05)}
    return adjusted(gauge=SimpleNamespace(**gauge), **fields)


def test_a_scene_that_moved_far_is_said_to_where_nothing_but_the_cameras_holds_it():
    assert reasons(moved(6.0)) == []
    (line,) = reasons(moved(6.1))
    assert line.startswith("The scene moved by +0.00 m east, -6.10 m north, +0.10 m up, more than 3 times the")
    dem = TerrainTest(30, 30, 40, 0.0, 1.0, 5.0)  # which may lift a scene, not carry it off
    (line,) = reasons(moved(6.1, terrain=dem))
    assert line.endswith("check that the heights are of this place, or add GCPs.")
    for terrain, told in (
        (None, 1),
        (dem, 0),
        (TerrainTest(0, 0, 40, 0.0, 1.0, 5.0), 1),
    ):  # one that constrains nothing
        lifted = moved(6.1, terrain=terrain)
        lifted.gauge.shift = np.array([0.0, 0.1, 50.0])
        assert len(reasons(lifted)) == told
    assert reasons(moved(6.1, reference_inlier=np.ones(2, bool), terrain=dem)) == []
    assert reasons(moved(6.1), known=frozenset("A")) == []
    fixed = SimpleNamespace(**{**vars(adjusted().options), "fixed": ("A",)})
    assert reasons(moved(6.1, options=fixed)) == []
    for used, num in ((True, 0), (False, 1)):
        test = ControlTest(np.array([used]), np.zeros((1, 3)), np.zeros(1), np.ones(1))
        found = [line for line in reasons(moved(6.1, control=test)) if line.startswith("The scene moved")]
        assert len(found) == num


def control(**fields: Any) -> ControlTest:
    usual = {"used": np.ones(3, bool), "residual": np.zeros((3, 3)), "w": np.ones(3), "redundancy": np.full(3, 0.5)}
    return ControlTest(**{**usual, **fields})


def gcps(num: int = 3, view=(0, 1, 2, 0), point=(0, 1, 2, 1), left_out=()) -> Any:
    names = [f"P{k}" for k in range(num)]
    return SimpleNamespace(names=names, view=np.array(view), point=np.array(point), left_out=left_out)


def test_control_that_is_wrong_is_named_with_how_far_it_is_off():
    residual, w = np.array([[3.0, 4.0, 0.0], [0, 0, 0], [0, 0, 0.02]]), np.array([6.0, 1.0, 4.5])
    found = reasons(adjusted(control=control(residual=residual, w=w, used=np.array([False, True, True]))), gcps=gcps())
    assert found == [
        "1 GCP rejected, as the others contradict it: P0 (+3.00 m east, +4.00 m north, +0.00 m up, w = 6.0), predicted "
        "minus given. Check coordinates, axes and image positions.",
        "1 GCP used, with residuals above 4 standard deviations: P2 (+0.00 m east, +0.00 m north, +0.02 m up, "
        "w = 4.5), predicted minus given. Check coordinates and stated accuracies.",
    ]


def test_control_that_scatters_is_said_to_unless_one_is_named():
    scattered = control(fits=False, scatter=3.21, used=np.array([True, True, False]))
    assert reasons(adjusted(control=scattered), gcps=gcps())[1:] == [
        "2 GCPs scatter 3.2 times as much as stated. Check their coordinates and stated accuracies."
    ]
    named = reasons(adjusted(control=control(fits=False, scatter=2.34, w=np.array([1.0, 4.5, 1.0]))), gcps=gcps())
    assert [text.split()[1:3] for text in named] == [["GCP", "used,"]]
    assert reasons(adjusted(control=control()), gcps=gcps()) == []
    assert reasons(adjusted(), gcps=gcps(left_out=("a: no such image",))) == ["a: no such image."]


def test_control_that_is_not_used_says_why():
    off, few = np.array([[1.0, -2.0, 3.0], [NO_NUMBER] * 3, [3.0, 0.0, 1.0]]), NO_NUMBER

    def said(*used: int, w: Any = (9.5, few, 1.0), **agreed: Any) -> str:
        agreement = Agreement(np.array(used, bool), **agreed)
        tested = control(residual=off, w=np.array(w), used=agreement.used, agreed=agreement)
        (line,) = reasons(adjusted(control=tested), gcps=gcps())
        return line

    of_few, cure = "P1 (in too few images to determine its error)", "Check coordinates, axes and image positions."
    assert said(0, 0, 1) == (
        f"2 GCPs rejected, as the others contradict them: P0 ({enu(off[0])}, w = 9.5), {of_few}, predicted minus "
        f"given. {cure}"
    )
    assert said(1, 0, 1, w=(1.0, few, 1.0)).endswith(f"{of_few}. {cure}")
    assert said(0, 0, 1, alike=True).endswith(f"{cure} They agree with each other: check their datum and heights, too.")
    apart = f"(predicted minus given differs by {enu(off[0] - off[2])})"
    for one, told in (([1, 1, 0], f"P0, P1 against P2 {apart}"), ([0, 1, 0], "P1 against P2")):
        sets = np.array(one, bool), np.array([False, False, True])
        assert f"GCPs contradict each other, {told}, and none was used." in said(0, 0, 0, sets=sets)
    assert "the RMS of check tie points rises from 0.100 to 0.250 px" in said(0, 0, 0, torn=(0.1, 0.25))


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"adjustment": adjusted(control=control(used=np.arange(3) < 2)), "gcps": gcps()}, "1 GCP rejected"),
        ({"adjustment": adjusted(control=control(w=np.array([1.0, 1.0, 4.5]))), "gcps": gcps()}, "w = 4.5"),
        ({"gcps": gcps(left_out=("a.csv: names unknown.tif",))}, "unknown.tif"),
        ({"check_points": gcps(left_out=("a.csv: names unknown.tif",))}, "unknown.tif"),
    ],
)
def test_ground_points_with_a_reservation_need_a_look(fields, word):
    found = block_verdict(run_of(**fields), views())
    assert (found["status"], found["passed"]) == ("look", False)
    assert found["headline"] == "All 3 images are adjusted; ground points need review."
    (reason,) = found["reasons"]
    assert word in reason


def test_a_reference_that_shows_something_else_is_of_no_use():
    matches = tuple(ViewMatch(name, peak, (0.0, 0.0)) for name, peak in (("A", 3.2), ("B", 5.1)))
    (line,) = reasons(reference=ReferenceControl(None, matches, 1.0, 1.0))
    assert f"(its highest peak has 5.1 standard deviations, {PEAK:g} are needed)" in line
    assert "and was not used: check its place and that cameras are not more than 1 km off, or give another." in line
    (line,) = reasons(reference=ReferenceControl(None, (ViewMatch("A", PEAK, (0.0, 0.0)), *matches), 1.0, 1.0))
    assert "and was not used: check the place of the DEM under it, or give a newer or finer one." in line
    (line,) = reasons(reference=ReferenceControl(None, (), 1.0, 1.0))
    assert "has 0.0 standard" in line
    of_use = (ViewMatch("A", 9.0, (0.0, 0.0), tried=9, points=4),)
    assert reasons(reference=ReferenceControl(SimpleNamespace(), of_use, 1.0, 1.0)) == []


# --- what was reached -------------------------------------------------------------------------------------


def test_what_tie_points_agree_to_is_the_median_over_the_images():
    of = [
        a_view(name, rmse_before=b, rmse_after=a) for name, b, a in (("A", 1.0, 0.3), ("B", 5.0, 0.1), ("C", 2.0, 0.2))
    ]
    lines = said(run_of(), of)
    assert (
        lines[0] == "Tie points of 3 images have residuals of 0.200 px (median of the images' RMS; before: 2.000 px)."
    )
    assert "The adjustment moved the scene by +1.00 m east, -2.00 m north, +3.00 m up." in lines
    assert (
        lines[-1]
        == "Without ground control, the scene's position is uncertain by 10 m, 20 m, 5.0 m (east, north, up; 1 "
        "sigma)."
    )
    assert len(lines) == 3
    without = said(run_of(tracks=[]), of)
    assert without[0] == "There are no tie points: control alone constrains the cameras."
    assert not any("moved the scene by" in line for line in without)
    assert any("moved the scene by" in line for line in said(run_of(tracks=[], gcps=gcps()), of))
    check = block_verdict(run_of(kind="check"), of)["verdict"]
    assert check == [
        "Tie points of 3 images have residuals of 2.000 px with the cameras as given (median of the images' RMS)."
    ]


def test_control_is_said_to_hold_the_place_and_when_nothing_checks_it():
    def lines(test=None, points=None, of=None) -> str:
        return "\n".join(said(run_of(adjusted(control=test), gcps=points or gcps()), of))

    assert "With 3 GCPs, the scene's position is uncertain by 10 m, 20 m, 5.0 m (east, north, up; 1 sigma)." in lines(
        control()
    )
    assert "With 1 GCP, the scene's position" in lines(control(used=np.array([True, False, False])))
    assert (
        "Without ground control, the scene's position is uncertain by 10 m, 20 m, 5.0 m (east, north, up; 1 sigma)."
        in lines(control(used=np.zeros(3, bool)))
    )
    assert "With 2 GCPs" in lines(None, gcps(view=(0, 1), point=(0, 2)))  # those that are seen
    assert "With 2 GCPs" in lines(control(), gcps(view=(0, 1), point=(0, 2)))
    blind = control(redundancy=np.full(3, 0.05))
    assert "Nothing checks them: an error in a GCP would not show." in lines(blind)
    assert "Nothing checks" not in lines(control(redundancy=np.full(3, 0.05), used=np.array([False, True, False])))
    single = gcps(1, view=(0, 1), point=(0, 0))
    one = ControlTest(np.ones(1, bool), np.zeros((1, 3)), np.ones(1), np.full(1, 0.05))
    assert "Nothing checks it: an error in a GCP would not show." in lines(one, single)
    assert "Nothing checks" not in lines(control())
    assert "Nothing checks" not in lines(control(redundancy=np.full(3, 0.05), fits=False))
    assert "Nothing checks" not in lines(control(redundancy=np.full(3, 0.05), used=np.zeros(3, bool)))
    alone = gcps(view=(1, 1, 1), point=(0, 1, 2))
    assert "Only B shows GCPs that are used: they do not constrain the scene along its lines of sight." in lines(
        control(), alone
    )
    assert "Only" not in lines(control())
    of_both = gcps(view=(1, 1, 0), point=(0, 1, 2))
    assert "Only B shows GCPs" in lines(control(used=np.array([True, True, False])), of_both)
    assert "Only" not in lines(control(), of_both)
    assert "Only" not in lines(control(used=np.zeros(3, bool)), alone)
    assert "Only" not in lines(control(), alone, [a_view("B")])


def test_a_dem_is_said_to_hold_and_how_the_points_lie_to_it():
    def lines(held=30, known=20, total=40, offset=2.0, spread=3.0, bias=0.5, **fields: Any) -> list[str]:
        terrain = TerrainTest(held, known, total, offset, spread, bias)
        return said(run_of(adjusted(terrain=terrain, **fields)))[-2:]

    assumed = "DEM accuracy assumed: 50 cm shared by all points, 2.0 m each"
    assert lines() == [
        "DEM heights constrain 30 of 40 used tie points; the DEM covers 50 %.",
        f"{assumed}; measured: the tie points lie 2.0 m above it (median; scatter 3.0 m).",
    ]
    assert lines(known=40, offset=-2.0) == [
        "DEM heights constrain 30 of 40 used tie points.",
        f"{assumed}; measured: the tie points lie 2.0 m below it (median; scatter 3.0 m).",
    ]
    assert lines(known=0)[1] == f"{assumed}."
    assert lines(known=0, total=0, held=0)[1] == "The DEM constrains nothing: there are no tie points."
    held = "DEM heights constrain 0 of 40 used tie points: "
    nowhere = f"{held}the DEM has no height where one is needed; the DEM covers 50 %."
    assert lines(held=0)[1] == nowhere
    held = replace(TerrainTest(30, 30, 40, 2.0, 3.0, 0.5), sigma=4.0)
    for terrain, start in (
        (held, "With the DEM, the scene's position"),
        (replace(held, shows=False), "Without ground control, the"),
    ):
        assert any(line.startswith(start) for line in said(run_of(adjusted(terrain=terrain))))
    terrain = TerrainTest(0, 20, 40, 2.0, 3.0, 0.5)
    assert said(run_of(adjusted(terrain=terrain, held=np.array([False, True]))))[-1] == nowhere


def test_how_much_of_a_dem_is_believed_is_said():
    told = replace(TerrainTest(30, 30, 40, 2.0, 3.0, 0.5), sigma=4.0, alike=3.5, relief=0.98)
    assert said(run_of(adjusted(terrain=told)))[-2:] == [
        "DEM accuracy assumed: 50 cm shared by all points, 4.0 m each; measured: the tie points lie 2.0 m above it "
        "(median; scatter 3.0 m).",
        "DEM errors are correlated: 3.5 points count as one.",
    ]
    assert wrong(told) == []
    assert wrong(replace(told, is_known=False)) == []


def told_of(terrain: TerrainTest) -> Any:
    return run_of(adjusted(terrain=terrain))


def wrong(terrain: TerrainTest) -> list[str]:
    return reasons(adjusted(terrain=terrain))


def test_what_is_wrong_with_a_dem_is_said_and_needs_a_look():
    right = replace(TerrainTest(30, 30, 40, 2.0, 3.0, 5.0), delivered=(-14.0, 9.0, -9.0), beyond=(2.9, 2.9, 2.9))
    assert wrong(right) == []
    below = replace(right, delivered=(51.0, 9.0, -9.0), beyond=(3.4, 1.0, 1.0))
    (why,) = wrong(below)
    assert why.startswith(
        "The DEM is 51.0 m below the tie points of the delivered cameras, 3.4 times the standard deviation"
    )
    assert why.endswith("Check its heights, their datum, and the cameras.")
    (why,) = wrong(replace(right, beyond=(1.0, 2.0, 3.1)))
    assert why.startswith("The DEM is tilted against the tie points of the delivered cameras, by 9.0 m to the north at")
    (why,) = wrong(replace(right, beyond=(1.0, 9.0, 3.1)))
    assert "by 9.0 m to the east and 9.0 m to the north at" in why
    other = replace(below, shows=False, relief=3.28)
    (why,) = wrong(other)
    assert "The DEM was not used: its relief is 3.3 times that of the tie points. Check its place" in why
    verdict = block_verdict(told_of(other), views())
    assert verdict["status"] == "look"
    assert not any("DEM heights" in line for line in verdict["verdict"])


def test_a_reference_is_said_to_hold_what_and_how_far_off_the_cameras_were():
    def lines(*matches: ViewMatch) -> str:
        return "\n".join(said(run_of(reference=ReferenceControl(SimpleNamespace(), matches, 0.5, 1.0))))

    one = ViewMatch("A", 9.5, (3.0, -4.0), tried=50, points=20)
    two = ViewMatch("B", 8.25, (0.0, 1.0), tried=30, points=10)
    none = ViewMatch("C", 2.0, (0.0, 0.0), tried=99, points=0)
    text = lines(one, two, none)
    assert "The reference was matched at 30 of 80 points in 2 images, to 50 cm." in text
    assert "By the reference, the delivered cameras are off by 5.0 m (A), 1.0 m (B)." in text
    assert "No point of the reference was matched in C." in text
    sharp = replace(one, gsd=0.4)
    assert "in 1 image, to 50 cm (1.2 px)." in lines(sharp)
    assert "The scene's position is uncertain by 10 m, 20 m, 5.0 m (east, north, up; 1 sigma)." in text
    assert "No point" not in lines(one, two)
    assert "in 1 image," in lines(one)
    many = lines(*(ViewMatch(f"V{k}", 9.0, (3.0, 4.0), tried=1, points=1) for k in range(7)))
    assert "5.0 m (V4) and 2 more." in many
    useless = said(run_of(reference=ReferenceControl(None, (none,), 0.5, 1.0)))
    assert any(line.startswith("Without ground control") for line in useless)
    with_gcps = said(
        run_of(
            adjusted(control=control()), gcps=gcps(), reference=ReferenceControl(SimpleNamespace(), (one,), 0.5, 1.0)
        )
    )
    assert any(line.startswith("With 3 GCPs") for line in with_gcps)


def test_the_order_of_reasons_is_what_failed_then_what_needs_a_look_then_files_block_and_points():
    of = [a_view("A", status="weak", advice="a"), a_view("B", status="failed", advice="b"), a_view("C")]
    run = run_of(adjusted(noise=3.0), left_out=(("f.tif", "no RPC"),), check_points=gcps(left_out=("p",)))
    found = block_verdict(run, of)
    assert [reason.split()[0] for reason in found["reasons"]] == ["B:", "A:", "f.tif", "Tie", "p."]
    assert found["verdict"][-5:] == found["reasons"]
    assert found["status"] == "bad"


def test_tie_points_alone_are_counted():
    tracks = type("Ties", (), {"num_points": 7, "__len__": lambda _: 19})()
    found = block_verdict(run_of(kind="match", tracks=tracks), views())
    assert found["verdict"] == ["7 tie points of 3 images, 19 observations."]
    assert found["headline"] == "All 3 images are matched."


def test_a_reference_on_heights_that_may_be_above_a_geoid_is_no_jitter():
    unstated = replace(TerrainTest(0, 0, 0, np.nan, np.nan, 20.0), is_known=False)
    held = {"terrain": unstated, "reference_inlier": np.array([True, True])}
    assert not [line for line in said(run_of(adjusted(**held))) if "DEM heights" in line]  # there is no tie point
    for less in ({"terrain": replace(unstated, is_known=True)}, {"reference_inlier": np.zeros(2, bool)}):
        assert reasons(adjusted(**{**held, **less})) == []
    smooth = SmoothTest(np.array([0.2, 0.0, 0.0]), np.array([1e-9, 1, 1]), np.full(3, 0.9), np.zeros(3))
    for fields, words in (
        (held, "remain: heights of the DEM without --geoid, or attitude jitter"),
        ({**held, "terrain": None}, "or correlated matching errors, or distortions of the reference or of the heights"),
        ({}, "which one RPC cannot represent, or correlated matching errors"),
    ):
        told = view_status(a_view("A"), run_of(adjusted(**fields, smooth=smooth)))["advice"]
        assert words in told
        assert ("reference" in told) == ("reference" in words)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"along": 5.0}, ""),
        ({"along": 20.0}, "points scatter along the lines of sight by 20 m in A, as with height errors of 99 m (2.0 m"),
        ({"scatter": 9.9}, ""),
        ({"scatter": 10.1}, "than the resolution of its matches, 10 m, in A (10 m). Check it for distortions, and"),
    ],
)
def test_a_reference_on_heights_of_another_place_or_with_points_off_by_more_than_its_pixel_is_told(fields, told):
    fine = ViewMatch("B", 9.0, (1.0, 0.0), 90, 50, 40, 2.0, 2.0, 0.2, 5.0)
    matches = replace(fine, name="A", **fields), fine, ViewMatch("C", 3.0, (0.0, 0.0))
    found = reasons(reference=ReferenceControl(SimpleNamespace(), matches, 10.0, 2.5))
    assert len(found) == bool(told)
    assert told in "".join(found)
    assert "B" not in "".join(found).rpartition("in A")[2]


def test_altimetry_says_how_well_it_agrees_or_why_it_holds_nothing():
    usual = {
        "agree": 70, "near": 80, "spread": 0.4, "expected": 0.5, "motion": np.array([1.0, -2.0, 3.0]), "total": 90,
        "given": 90, "why_not": "",
    }  # fmt: skip
    fine = run_of(adjusted(altimetry=SimpleNamespace(**usual)))
    line = (
        "70 of 80 altimetry heights agree with the surface of the tie points to 40 cm (50 cm expected); they "
        f"shifted it by {enu(np.array([1.0, -2.0, 3.0]))}."
    )
    assert line in said(fine)
    assert any(one.startswith("The scene's position is uncertain") for one in said(fine))
    assert not any("altimetry" in one for one in block_verdict(fine, views())["reasons"])
    odd = run_of(adjusted(altimetry=SimpleNamespace(**{**usual, "why_not": "they lie elsewhere"})))
    assert not any("altimetry heights agree" in one for one in said(odd))
    (reason,) = block_verdict(odd, views())["reasons"]
    assert reason.startswith("The altimetry was not used: they lie elsewhere (")


@pytest.mark.parametrize(
    ("spread", "expected", "words"),
    [
        (1.24, 0.5, ""),
        (1.26, 0.5, "by 2.5 times"),
        (5.0, 0.5, "by 10 times"),
        (0.49, 0.1, ""),
        (0.51, 0.1, "by 5.1 times"),
    ],
)
def test_altimetry_that_scatters_by_a_pixel_and_more_than_expected_needs_a_look(spread, expected, words):
    test = SimpleNamespace(agree=70, near=80, spread=spread, expected=expected, motion=np.ones(3), given=90, why_not="")
    reasons = block_verdict(run_of(adjusted(altimetry=test)), views())["reasons"]
    assert len(reasons) == bool(words)
    assert words in "".join(reasons)


@pytest.mark.parametrize(("whole", "sharp", "said"), [(87, 0, True), (87, 100, False), (0, 87, False)])
def test_matches_at_whole_pixels_are_told_unless_as_many_are_sharper(whole, sharp, said):
    pair = {"status": "ok", "names": ("A", "B")}
    matched = (
        SimpleNamespace(**pair, matcher="fine-structure", verified=whole),
        SimpleNamespace(**pair, matcher="structure", verified=sharp),
        SimpleNamespace(status="no common offset", names=("A", "C"), matcher="fine-structure", verified=9),
    )
    run = Run("adjust", (), (), Tracks(*np.zeros((2, 0), int), np.zeros((0, 2)), np.zeros(0)), matched)
    assert run.whole_pixels == (frozenset("AB") if said else frozenset())
    told = view_status(a_view("A"), run_of(whole_pixels=run.whole_pixels))
    assert (told["cause"] == "whole_pixels") == said
    if said:
        assert "so all may share an error of 0.3 px" in str(told["advice"])
        assert view_status(a_view("A", num_gcps=3), run_of(whole_pixels=run.whole_pixels))["cause"] is None
        assert view_status(a_view("A"), run_of(kind="match", whole_pixels=run.whole_pixels))["cause"] is None


@pytest.mark.parametrize(
    ("beyond", "updated", "said_of_them"),
    [
        ((), True, "Their cameras stay valid: the largest change, of C, is 0.012 px (limit: 0.02 px)."),
        ((("C", 1.234),), False, "The cameras of first were held as they are written; they move by up to 0.01 px (C) "
         "where --update adjusts all together."),
        ((("C", 1.234), ("B", 0.5)), True, "The cameras of 2 images of first change by more than 0.02 px: C (1.23 px), "
         "B (0.50 px); their new cameras are written here."),
    ],
)  # fmt: skip
def test_added_images_leave_the_cameras_of_a_run_or_ask_them_to_move(beyond, updated, said_of_them):
    lines = said(run_of(added=Added("first", 11, 2, beyond, ("C", 0.0123), 0.02, updated)))
    at = lines.index("1 image added to the 11 images of first; 2 of these have new tie points.")
    assert lines[at + 1] == said_of_them


def test_images_that_contradict_cameras_held_need_a_look():
    change = Added("first", 11, 2, (), ("C", 0.0123), 0.02, updated=False, contradicted=("A", 0.3, 0.1))
    (why,) = block_verdict(run_of(added=change), views())["reasons"]
    assert why == (
        "Check tie points of A have residuals of 0.300 px with the cameras of first as they are written, and of 0.100 "
        "px with all cameras free. Run again with --update, which adjusts all."
    )


@pytest.mark.parametrize(("as_stated", "error"), [(True, "wrong tie points or an RPC"), (False, "an RPC")])
def test_of_images_that_cannot_be_told_apart_each_is_named(as_stated, error):
    found = SimpleNamespace(
        clear=False, views=(0, 2), look=SimpleNamespace(as_stated=as_stated), is_view=lambda _: False
    )
    reasons = block_verdict(run_of(adjusted(apart=found)), views())["reasons"]
    assert any(
        f"One of the images A, C has {error} that does not match it: the rest agree without any one" in one
        for one in reasons
    )


@pytest.mark.parametrize(
    ("agrees", "used", "scale", "words"),
    [
        (True, 3, 1.0, "With 3 GCPs, it is known to a metre."),
        (False, 0, 1.0, "Without consistent ground control, it is known to a metre."),
        (False, 2, 4.4, "With 2 GCPs, 4 times less accurate than stated, it is known to a metre."),
        (False, 1, 1.0, "The 1 GCP in use do not agree: the uncertainty of the scene's position is unknown."),
    ],
)
def test_what_control_holds_is_said_with_how_far_it_agrees(agrees, used, scale, words):
    tested = SimpleNamespace(agrees=agrees, used=np.arange(4) < used, agreed=SimpleNamespace(scale=scale), checked=True)
    points = SimpleNamespace(names="PQRS", point=np.array([0, 1, 2, 2]), view=np.array([0, 1, 1, 0]))
    assert next(held_lines(tested, points, views(), "it is known to a metre")) == words


def displaced(first: float, px: float = 1.0, *, view: int = 0, axis: int = 0, or_of: tuple[int, ...] = ()) -> Finding:
    """A displaced part of an image."""
    size = np.array([px, 0.0])
    return Finding("step", view, (axis, first, 1e6, 0.0, 0.0), size, 9.0, 9.0, "", size, or_of=or_of)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_many_displaced_detectors_of_an_image_are_one_sentence(count):
    """Of one image alone; rows, other images and parts that another image may have keep a sentence of their own."""
    parts = [displaced(100.0 * n, 0.1 * n) for n in range(1, count + 1)]
    found = adjusted(
        findings=[displaced(5.0, axis=1), *parts, displaced(7.0, view=1), displaced(9.0, or_of=(2,))],
        cameras=SimpleNamespace(unknowns=SimpleNamespace(drift=1, half=np.full((2, 3), 2000.0))),
    )
    rows, *own, of_b, or_c = (f"{one.sentence[0].upper()}{one.sentence[1:]}." for one in explanations(found))
    if count > 2:
        edges = ", ".join(f"{100 * n}" for n in range(1, count + 1))
        size = f"{0.1 * count:.2f} px, as by detectors with edges at"
        own = [f"{count} parts of the columns of A are displaced by up to {size} {edges}."]
    assert [line for line in said(run_of(found)) if "displaced" in line] == [rows, *own, of_b, or_c]
