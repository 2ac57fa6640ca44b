"""Heights above the ellipsoid or the sea: what the cameras and other heights tell of it, and what nothing does."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.constraints.gauge import SOURCES
from barpc.ba.constraints.ground import TerrainTest
from barpc.base.geodesy import DEFAULT, INFERRED, STATED, HeightDatum
from barpc.report.datum import datum_reasons
from barpc.report.verdict import common_lean
from tests.report.made import a_view

GEOID = 48.0


def block(up: float = 0.0, cameras: float = 10.0, known: float = 0.5, source: str = "gcps", **fields: Any) -> Any:
    """A block that `source` holds, `up` above where the cameras as delivered put it, to `cameras` [m]."""
    shares = {name: np.where(np.arange(10) == 2, float(name == source), np.nan) for name in SOURCES}
    gauge = SimpleNamespace(
        shift=np.array([0, 0, up]), sigma=np.array([0.4, 0.4, known]), delivered_sigma=np.array([9, 9, cameras])
    )
    usual = {"control": None, "terrain": None, "prior": SimpleNamespace(scale=np.ones(3))}
    return SimpleNamespace(gauge=gauge, datum=shares, **{**usual, **fields})


def told(adjustment: Any, provenance: str = DEFAULT, otherwise: float = GEOID, **fields: Any) -> list[str]:
    return [*datum_reasons([HeightDatum("gcps", "6 GCPs", otherwise, provenance, **fields)], adjustment, 0.0)]


@pytest.mark.parametrize("provenance", [DEFAULT, INFERRED, STATED])
@pytest.mark.parametrize("sign", [1, -1])
def test_heights_that_lie_as_far_off_as_the_geoid_seem_to_count_from_it(provenance, sign):
    """Above and below the ellipsoid: whoever says so, as long as it is no person."""
    (why,) = told(block(-sign * 46.0), provenance, sign * GEOID)
    side, geoid = ("below", "above") if sign > 0 else ("above", "below")

    def cure(other: str, present: str) -> str:
        if provenance == STATED:
            return "Their file states the opposite: check it."
        return f"Give --heights {other}, or --heights {present} to confirm the present datum."

    assert why == (
        f"The heights of 6 GCPs lie 46 m {side} those by the cameras or other heights; the geoid lies "
        f"48 m {geoid} the ellipsoid here. They seem to be above sea level. {cure('egm96', 'ellipsoidal')}"
    )
    (why,) = told(block(sign * 46.0), provenance, -sign * GEOID, converted=True)
    assert (
        f"the geoid lies 48 m {geoid} the ellipsoid here. They seem to be ellipsoidal. {cure('ellipsoidal', 'egm96')}"
        in why
    )


@pytest.mark.parametrize("up", [0.0, 9.0, -9.0, 25.0])
def test_what_the_cameras_settle_needs_no_word(up):
    assert told(block(up)) == []


@pytest.mark.parametrize(("cameras", "known", "said"), [(30.0, 0.5, True), (30.0, 48.0, False), (10.0, 0.5, False)])
def test_what_nothing_settles_is_said_where_it_moves_the_scene(cameras, known, said):
    found = told(block(5.0, cameras, known))
    assert len(found) == said
    assert told(block(5.0, cameras, known), INFERRED) == []
    if said:
        assert "if they are above sea level, the scene is 48 m too low" in found[0]
        assert "--heights ellipsoidal, or --heights egm96" in found[0]
        assert "48 m too high" in told(block(5.0, cameras, known), otherwise=-GEOID)[0]


def test_heights_that_hold_a_part_of_the_scene_move_a_part_of_it():
    half = block(-23.0, 30.0)
    half.gauge.shift[0] = 20.0
    half.datum["gcps"] = np.full(10, 0.5)
    assert "the scene is 24 m too low" in told(half)[0]
    half.gauge.delivered_sigma[2] = 10.0  # 46 m, of which half came about
    assert "lie 46 m below" in told(half)[0]


def test_other_heights_tell_where_cameras_do_not():
    wide = block(20.0, 500.0)
    assert told(wide, above=((1.0, 6.0),)) == []
    assert "lie 47 m below" in told(wide, above=((-47.0, 6.0),))[0]
    assert "is not stated" in told(wide, above=((-20.0, 30.0),))[0]
    assert told(block(-150.0), INFERRED) == []  # neither: something else is wrong, and it is not said of the datum


def test_cameras_that_were_widened_by_control_count_as_delivered():
    wide = block(-46.0, 50.0, prior=SimpleNamespace(scale=np.full(3, 5.0)))
    assert "seem to be above sea level" in told(wide)[0]


def test_control_that_was_refused_is_held_against_the_others():
    control = SimpleNamespace(used=np.zeros(4, bool), residual=np.tile([0.0, 0.0, 47.0], (4, 1)))
    refused = block(0.0, known=5.0, control=control)
    refused.datum["gcps"] = np.full(10, np.nan)
    assert "lie 47 m below" in told(refused, INFERRED)[0]


def test_a_dem_is_held_against_the_tie_points_without_what_it_may_be_wrong_by():
    terrain = replace(TerrainTest(30, 30, 40, 2.0, 3.0, 20.0), delivered=(47.0, 0.0, 0.0), beyond=(47 / 22.4, 0, 0))
    one = HeightDatum("heights", "the DEM d.tif", GEOID, DEFAULT)
    (why,) = datum_reasons([one], block(source="heights", terrain=terrain), 0.0)
    assert "The heights of the DEM d.tif lie 47 m below" in why
    assert "Give --geoid egm96" in why
    (why,) = datum_reasons(
        [replace(one, converted=True, otherwise=48.0)], block(source="heights", terrain=terrain), 0.0
    )
    assert "Give --geoid none" in why
    for off in (1.0, -8.0):
        right = replace(terrain, delivered=(off, 0.0, 0.0), beyond=(abs(off) / 22.4, 0, 0))
        assert [*datum_reasons([one], block(source="heights", terrain=right), 0.0)] == []
    unknown = block(source="heights", terrain=replace(terrain, beyond=(np.nan,) * 3))
    (why,) = datum_reasons([one], unknown, 0.0)
    assert why.startswith("The vertical datum of the heights of the DEM d.tif is not stated.")
    assert [*datum_reasons([one], block(source="reference", terrain=None), 0.0)] == [why]  # which stands on it


@pytest.mark.parametrize(
    ("lean", "share", "aside"), [(0.27, 1.0, "13"), (0.27, 0.5, "6.5"), (1 / 12, 1.0, ""), (0.0, 1, "")]
)
@pytest.mark.parametrize("source", ["gcps", "heights"])
def test_heights_that_shift_a_scene_seen_from_one_side_by_less_than_is_known_of_its_own(source, lean, share, aside):
    """One image on points of a wrong height: known to 60 m in height and to 4 m sideways, 48 m times lean is more."""
    one = block(known=60.0, source=source)
    one.gauge.sigma[:2], points = (2.4, 3.2), {"gcps": "gcps", "heights": "reference"}[source]
    one.datum[points] = np.where(np.arange(10) == 2, np.nan_to_num(one.datum[points][2]), share)
    one.gauge.delivered_sigma[2] = 500.0
    found = [*datum_reasons([HeightDatum(source, "them", GEOID, DEFAULT)], one, lean)]
    assert len(found) == bool(aside)
    if aside:
        assert f"the scene is up to {aside} m off horizontally. Give " in found[0]
        assert found[0].endswith("--geoid none, or --geoid egm96." if source == "heights" else "--heights egm96.")


@pytest.mark.parametrize(
    ("angles", "lean"),
    [([(30, 0)], 0.577), ([(30, 0), (30, 180)], 0.0), ([(30, 359), (30, 1)], 0.577), ([(None, 1)], 0)],
)
def test_the_common_lean_of_lines_of_sight_cancels_from_opposite_sides(angles, lean):
    views = [a_view(incidence_deg=incidence, azimuth_deg=azimuth) for incidence, azimuth in angles]
    assert common_lean(views) == pytest.approx(lean, abs=1e-3)
