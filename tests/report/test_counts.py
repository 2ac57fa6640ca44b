"""Sentences of none, one and two of everything: no 'All 1 images', no '0 of 0', no number that is none."""

from __future__ import annotations

import re
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.constraints.ground import TerrainTest
from barpc.report import page
from barpc.report.decisions import decisions
from barpc.report.summary import TracksEntry
from barpc.report.verdict import block_verdict
from barpc.tie.reference import ReferenceControl, ViewMatch

from .made import a_correction, a_gcp, a_pair, a_square, a_summary, a_view, files_of
from .test_sentences import adjusted, control, gcps, run_of

WRONG = re.compile(
    r"\b1 (images|pairs|points|tie points|GCPs|check points|observations|files|groups|columns)\b(?! of)"
    r"|\b0 of 0\b|\bAll [012] |\ball [012] |\bnan\b|\binf\b|\bNone\b"
)


def spoken(lines: Any) -> None:
    said = [line for line in lines if line]
    assert said
    for line in said:
        assert not WRONG.search(line), line


class Ties:
    def __init__(self, num: int) -> None:
        self.num_points = num

    def __len__(self) -> int:
        return 2 * self.num_points


def the_views(num: int, seen: int, **fields: Any) -> list[Any]:
    error = {"rmse_before": 1.0, "rmse_after": 0.1} if seen else {"rmse_before": None, "rmse_after": None}
    return [a_view(name, num_observations=seen, **error, **fields) for name in "ABC"[:num]]


@pytest.mark.parametrize("kind", ["adjust", "check", "match"])
@pytest.mark.parametrize(("num", "seen"), list(product((1, 2, 3), (0, 1, 2))))
def test_images_and_tie_points(kind, num, seen):
    found = block_verdict(run_of(kind=kind, tracks=Ties(seen)), the_views(num, seen))
    spoken([found["headline"], *found["verdict"]])
    if kind == "adjust":
        assert found["headline"].split(" are")[0].split(" is")[0] == {1: "The image", 2: "Both images"}.get(
            num, "All 3 images"
        )


@pytest.mark.parametrize(("num", "seen"), [(1, True), (1, False), (2, True), (2, False)])
def test_check_points(num, seen):
    """Each in an image of its own, so that none has a residual on the ground."""
    camera = SimpleNamespace(project=lambda ground: np.full((len(ground), 2), 0.2 if seen else np.nan))
    points = gcps(num, view=range(num), point=range(num))
    points.lonlatalt, points.xy = np.zeros((num, 3)), np.zeros((num, 2))
    run = run_of(check_points=points, after=(camera,) * 3)
    (line,) = [line for line in block_verdict(run, the_views(3, 9))["verdict"] if "check point" in line]
    spoken([line])
    assert f"{num} check point{'s' * (num > 1)}" in line
    assert seen or line.endswith("can project them." if num > 1 else "can project it.")
    assert ("px in the images" in line) == seen


@pytest.mark.parametrize("num", [0, 1, 2])
def test_control_a_dem_and_a_reference(num):
    terrain = TerrainTest(num, num, num, 2.0 if num else np.nan, 3.0 if num else np.nan, 0.5)
    used = np.arange(3) < num
    matches = tuple(ViewMatch(name, 9.0, (1.0, 0.0), tried=1, points=1) for name in "AB"[:num])
    for fields in (
        {"adjustment": adjusted(terrain=terrain)},
        {"adjustment": adjusted(control=control(used=used)), "gcps": gcps()},
        {"adjustment": adjusted(), "reference": ReferenceControl(SimpleNamespace(), matches, 0.5, 1.0)},
        {"left_out": (("a.tif", "a.tif: no RPC"),) * num},
    ):
        found = block_verdict(run_of(**fields), the_views(3, 40))
        spoken([found["headline"], *found["verdict"]])
        left = [line for line in found["verdict"] if "a.tif" in line]
        assert len(left) == (num if "left_out" in fields else 0)


@pytest.mark.parametrize(("views", "pairs", "tracks"), list(product((1, 2), (0, 1), (0, 1, 2))))
def test_the_answers_of_the_page(views, pairs, tracks):
    shown = the_views(views, tracks, correction=a_correction())
    found = [a_pair("A", "B", tracks)] * (pairs and views == 2)
    lengths = TracksEntry(tracks, 2 * tracks, {"2": tracks} if tracks else {})
    summary = a_summary(shown, found, tracks=lengths, gcps=tuple(a_gcp(f"g{k}", 5.0, 43.0) for k in range(tracks)))
    files = files_of(summary, [a_square(10.0, 0.0)] * views)
    made = [section for make in page.SECTIONS if (section := make(files)) is not None]
    assert len(made) >= 4
    for section in made:
        spoken([section.key, section.answer, *section.points, *(words for _, words in section.charts)])
    spoken(["decisions:", *decisions(summary)])  # of nothing none
