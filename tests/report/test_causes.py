"""What is said of causes: sentences with the numbers that they stand for, and reasons only where they matter."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.evidence.scan import Interval
from barpc.ba.resection import RpcDiagnosis
from barpc.ba.select.foreign_camera import FOREIGN_CAMERA, ForeignCamera
from barpc.ba.terms.moving_ground import Motion
from barpc.ba.terms.term import Finding
from barpc.report import verdict
from barpc.report.measures.block import explanations, left_entries, strangeness

NAMES = "west", "east"


def adjustment(findings: Any = (), names: Any = NAMES, **fields: Any) -> Any:
    half = np.array([[4000.0, 2000.0, 4000.0], [6000.0, 3000.0, 6000.0]])
    usual = {"left": (), "apart": None, "changed": 0.0, "cameras": SimpleNamespace(unknowns=SimpleNamespace(half=half))}
    return SimpleNamespace(names=names, findings=findings, **{**usual, **fields})


def moving(motion: Motion, gap: float = 7.0) -> Any:
    """An adjustment with a group of tie points that move together, by `motion`."""
    return adjustment([Finding("moving_objects", -1, None, np.zeros(2), 42.0, gap, "step", np.zeros(0), motion=motion)])


def reasons(found: Any) -> list[str]:
    """What is said of places that stand out and of what else a group may be."""
    run: Any = SimpleNamespace(adjustment=found, met_worse=[])
    return list(verdict._of_places(run, found, ()))


@pytest.mark.parametrize(
    ("kind", "view", "where", "size", "sentence", "ends"),
    [
        (
            "step", 1, (1, 4999.4, 12000.0, 0.0, 0.0), (3.0, 4.0),
            "rows 5000-5999 of east (or the same ground in west, or it moves) are displaced by 5.00 px",
            (5000.0, 5999.0),
        ),
        (
            "step", 0, (0, -8000.0, 100.0, 0.0, 0.0), (0.0, -0.5),
            "columns 0-99 of west (or the same ground in east, or it moves) are displaced by 0.50 px", (0.0, 99.0),
        ),
        (
            "decay", 0, (1, -12000.0, 24000.0, 0.0, 1 / 400.0), (2.0, 0.0),
            "rows of west (or the same ground in east, or it moves) are displaced by 2.00 px at row 0, decaying in 400 "
            "rows",
            (0.0, 11999.0),
        ),
        ("low_frequency", 1, None, (0.3, 0.4),
            "rows of east or west have a low-frequency displacement of 0.50 px", (None, None)),
    ],
)  # fmt: skip
def test_a_finding_is_said_with_its_place_and_size(kind, view, where, size, sentence, ends) -> None:
    (found,) = explanations(adjustment([Finding(kind, view, where, np.array(size), 42.0, 7.0, "", np.zeros(2))]))
    assert found.sentence == sentence
    assert (found.name, found.image, found.gain, found.gap, found.runner_up) == (kind, NAMES[view], 42.0, 7.0, None)
    assert (found.first, found.last) == ends
    assert found.size_px == pytest.approx(np.hypot(*size))


@pytest.mark.parametrize(
    ("count", "or_of", "whose", "least"),
    [(3, (), "east", ""), (3, (0, 2), "east or west or north", ""), (2, (0,), "east or west", "at least ")],
)
def test_a_swing_is_said_with_its_period_and_whose_it_may_be(count, or_of, whose, least) -> None:
    """Of two images nobody sees what there is along the epipolar lines."""
    names = ("west", "east", "north")[:count]
    size, unknowns = np.array([0.06, 0.08]), np.array([0.06, 0.0, 0.0, 0.08])
    one = Finding("sinusoid", 1, None, size, 60.0, 2.0, "sinusoid" if or_of else "", unknowns, 199.6, or_of)
    (found,) = explanations(adjustment([one], names=names))
    displacement = f"sinusoidal displacement of {least}0.10 px with a period of 200 rows"
    assert found.sentence == f"rows of {whose} have a {displacement}"
    assert (found.image, found.period, found.first) == ("east", 199.6, None)
    assert found.candidates == (tuple(names[v] for v in or_of) or None)
    assert found.size_px == pytest.approx(0.1)


def same_ground(run: Any, *found: tuple[str, int, int, float, float]) -> list[str]:
    """What is said of findings: kind, view, axis, first and last row."""
    size, rate = np.ones(2), 0.01
    findings = [Finding(kind, v, (axis, *ends, 0.0, rate), size, 9.0, 9.0, "", size) for kind, v, axis, *ends in found]
    return list(verdict._of_same_ground(run, replace(run.adjustment, findings=tuple(findings))))


def test_rows_of_two_images_over_the_same_ground_are_said_to_move(block_run) -> None:
    """Neither rows over other ground, nor columns, nor two parts of one image; rows that run on past an end count."""
    run = block_run.run
    (width, height), (one, two) = run.views[0].size, (run.cameras[v] for v in (0, 1))

    def there(first: float, last: float) -> tuple[float, float]:
        ground = one.localize(np.column_stack([np.full(2, width / 2), (first, last)]), np.full(2, run.altitude))
        return tuple(np.sort(two.project(ground)[:, 1]))

    low, high = 0.4 * height, 0.5 * height
    (said,) = same_ground(run, ("step", 0, 1, low, high), ("decay", 1, 1, *there(low, high)))
    (first, last), (a, b) = np.ceil(there(low, high)), [view.name for view in run.views[:2]]
    assert said.startswith(f"Rows {low:.0f}-{high - 1:.0f} of {a} and {first:.0f}-{last - 1:.0f} of {b} show the same")
    half = there(low + 0.6 * (high - low), high + 0.6 * (high - low))  # of which less than half is in common
    assert same_ground(run, ("step", 0, 1, low, high), ("step", 1, 1, *half)) == []
    assert same_ground(run, ("step", 0, 1, low, high), ("step", 0, 1, low, high)) == []
    assert same_ground(run, ("step", 0, 0, low, high), ("step", 1, 0, *there(low, high))) == []
    assert same_ground(run, ("low_frequency", 0, 1, low, high), ("step", 1, 1, *there(low, high))) == []
    past = ("step", 0, 1, -9.0 * height, height / 2), ("step", 1, 1, -9.0 * height, there(0, height / 2)[1])
    assert len(same_ground(run, *past)) == 1


@pytest.mark.parametrize(("rate", "end"), [(0.01, "beginning"), (-0.01, "end")])
def test_images_that_settle_alike_are_said_once(rate: float, end: str) -> None:
    places = (1, -6000.0, 12000.0, 0.0, rate), (1, -3000.0, 6000.0, 0.0, rate)
    sizes = np.array([0.0, 1.0]), np.array([3.0, 4.0])
    each = [Finding("transient", v, places[v], sizes[v], 90.0, 40.0, "moving_objects", sizes[v]) for v in (0, 1)]
    (entry,) = explanations(adjustment(findings=each))
    assert entry.sentence == (f"rows at the {end} of all images are displaced by up to 5.00 px, decaying in 100 rows")
    assert (entry.image, entry.gain, entry.runner_up, entry.size_px) == (None, 90.0, "moving_objects", 5.0)
    steps = [replace(one, kind="step") for one in each]  # each image by itself
    assert [one.size_px for one in explanations(adjustment(findings=steps))] == [1.0, 5.0]


@pytest.mark.parametrize(
    ("side", "said"),
    [
        ("north-west", "35 % of the tie points, in the north-west of the block, move together"),
        ("", "35 % of the tie points, about 5.0500, 43.1000 deg, move together"),
    ],
)
def test_a_group_that_moves_is_said_with_its_share_and_place(side: str, said: str) -> None:
    (found,) = explanations(moving(Motion(1.14, (1, 0), 0.354, (5.0, 43.0, 5.1, 43.2), side)))
    assert found.sentence == (
        f"{said} (a cloud, water or shadows, or, between dates, a glacier, a landslide, a fault?), by 1.1 m from east "
        "to west apart from an effect of height, and were excluded; the larger part of the ground was taken to stand "
        "still"
    )
    assert (found.image, found.share, found.moved_m, found.between) == (None, 0.354, 1.14, ("east", "west"))
    assert found.box == (5.0, 43.0, 5.1, 43.2)
    assert (found.axis, found.first, found.size_px, found.runner_up) == (None, None, None, "step")
    assert type(found).read({**vars(found), "box": [5.0, 43.0, 5.1, 43.2]}) == found


@pytest.mark.parametrize(
    ("dates", "cause"),
    [
        (("2020-01-02", "2020-01-02"), "(a cloud, water or shadows?)"),
        (
            ("2020-01-02", "2021-03-04"),
            "(a glacier, a landslide, a fault, or change between 2020-01-02 and 2021-03-04?)",
        ),
        (("", "2021-03-04"), "(a cloud, water or shadows, or, between dates, a glacier, a landslide, a fault?)"),
    ],
)
def test_a_group_that_moves_is_ground_only_between_dates(dates: tuple[str, str], cause: str) -> None:
    """Of less than a third nothing is said of the rest; control points on it are named."""
    motion = Motion(1.14, (1, 0), 0.3, (5.0, 43.0, 5.1, 43.2), "west", ("P1", "P4"), dates)
    (found,) = explanations(moving(motion))
    assert f"together {cause}, by 1.1 m" in found.sentence
    assert found.sentence.endswith("of height, and were excluded, with the GCPs P1, P4")


@pytest.mark.parametrize(("gap", "told"), [(4.9, True), (5.1, False)])
def test_what_else_a_group_may_be_is_a_reason_where_ties_cannot_tell(gap: float, told: bool) -> None:
    said = (
        "Moving objects explain the tie points that move together hardly better than displaced rows or columns of an "
        "image. Check where these tie points lie."
    )
    assert reasons(moving(Motion(1.0, (0, 1), 0.2, (5.0, 43.0, 5.1, 43.2), ""), gap)) == [said] * told


def interval(view: int, share: float, off: float) -> Interval:
    return Interval(view, 1, 100.0, 400.0, 30.0, share, off, share > 0.3, 2.5)


def test_what_is_left_is_a_reason_where_it_is_much() -> None:
    left = [interval(0, 0.8, 0.0), interval(0, 0.4, 0.0), interval(1, 0.02, 0.19)]
    found = adjustment(left=left)
    first, second = reasons(found)
    assert first == (
        "In rows 100-399 of west 80 % of the tie points disagree with the rest of the image, typically by 2.5 px. "
        "Check for clouds, water, change there."
    )
    assert (
        second
        == "In rows 100-399 of east the tie points share a residual of 0.19 px. Check for clouds, water, change there."
    )
    assert [one.last for one in left_entries(found)] == [399.0] * 3
    assert reasons(adjustment(left=[interval(0, 0.1, 0.05)])) == []
    assert reasons(adjustment(left=[interval(0, 0.1, 0.09)])) == []  # of less than 0.1 px: a remark
    narrow = [replace(interval(0, 0.1, 0.19), part=1 / 32)]  # over a quarter of an eighth
    assert reasons(adjustment(left=narrow)) == []


def test_rows_of_which_most_ties_move_may_be_what_is_off() -> None:
    left = [replace(interval(view, 0.8, 0.0), moves=True) for view in (0, 1, 0, 1)]
    assert reasons(adjustment(left=left, changed=0.09)) == []
    (said,) = reasons(adjustment(left=left, changed=0.11))
    assert said == (
        "Most tie points of rows 100-399 of west, rows 100-399 of east, rows 100-399 of west, rows 100-399 of east "
        "move together: moving objects, or displaced rows. Check for clouds and water there."
    )


def apart_of(look: RpcDiagnosis, **given: Any) -> ForeignCamera:
    return ForeignCamera((1,), 420.0, 17.0, 0, 0.987, look, None, **given)


@pytest.mark.parametrize(
    ("look", "share", "said"),
    [
        (RpcDiagnosis(swapped=True), 1.0, "with its axes swapped (samples for lines) it would agree"),
        (RpcDiagnosis(np.array([400.0, -9.0])), 1.0, "shifted by -400.0 columns and +9.0 rows it would agree"),
        (
            RpcDiagnosis(np.array([0.0, 9.0]), -48.0), 1.0,
            "shifted by +0.0 columns and -9.0 rows, or its heights by +48 m, it would agree",
        ),
        (RpcDiagnosis(), 0.987, "more than 98 % of its tie points contradict"),
        (RpcDiagnosis(), 1.0, "all of its tie points contradict"),
        (RpcDiagnosis(as_stated=True), 0.61, "more than 61 % of its tie points contradict"),
        (RpcDiagnosis(as_stated=True), np.nan, "as delivered its tie points contradict"),
    ],
)  # fmt: skip
def test_a_strange_rpc_is_said_with_what_it_looks_like(look, share, said) -> None:
    assert strangeness(replace(apart_of(look), contradicted=share)).startswith(said)


def test_of_a_view_that_lies_where_it_is_stated_to_the_rpc_is_not_blamed_alone() -> None:
    clouds = apart_of(RpcDiagnosis(as_stated=True))
    assert strangeness(clouds).endswith("as delivered it agrees with them within its stated accuracy")
    (one,) = explanations(adjustment(apart=clouds))
    assert one.sentence.startswith("many tie points of east are wrong, or its RPC does not match the image: ")


def test_a_strange_rpc_is_an_explanation_where_it_is_clear() -> None:
    clear = apart_of(RpcDiagnosis(swapped=True))
    (one,) = explanations(adjustment(apart=clear))
    assert (one.name, one.image, one.gain, one.gap, one.runner_up) == (
        FOREIGN_CAMERA,
        "east",
        420.0,
        17.0,
        "foreign_camera: west",
    )
    assert one.sentence == f"the RPC of east does not match the image: {strangeness(clear)}"
    for other in (replace(clear, views=(1, 0)), replace(clear, gain=np.nan)):  # several; its prior told
        assert not explanations(adjustment(apart=other))
