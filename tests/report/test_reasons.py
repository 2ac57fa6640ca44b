"""Causes, their sentences and their remedies: true ones, and flags that exist."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest

import barpc
from barpc.ba.evidence.scan import Interval
from barpc.base.declarations import declared
from barpc.base.options import TieOptions
from barpc.cli import COMMANDS, cli
from barpc.cli.adjust import adjust
from barpc.report.outcome import Run
from barpc.report.quality_checks import view_status
from barpc.report.summary.words import CAUSES, STATUS_WORDS
from barpc.scene import Tracks

from .made import a_view
from .test_causes import interval
from .test_sentences import adjusted, run_of

FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def flags_of(command: Any) -> set[str]:
    return {name for one in command.params for name in (*one.opts, *one.secondary_opts)}


@pytest.mark.parametrize("cause", CAUSES)
def test_a_flag_in_a_remedy_is_one_of_adjust(cause):
    words = CAUSES[cause]
    assert words.status in STATUS_WORDS
    assert set(FLAG.findall(f"{words.remedy} {words.sentence}")) <= flags_of(adjust)
    assert words.label == words.label.strip(" .:")
    assert ": " not in words.remedy


def test_an_option_in_a_remedy_is_one_of_its_table():
    assert "min_overlap" in declared(TieOptions)


@pytest.mark.slow
def test_every_flag_that_any_message_names_exists_in_some_verb():
    known = {"--help", "--version"}.union(
        *(flags_of(cli.get_command(click.Context(cli, **cli.context_settings), name)) for name in COMMANDS)
    )
    known |= {"--quiet", "--verbose", "--debug", "--json", "--file"}  # (the last of projsync)
    missing = set()
    for path in Path(barpc.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                missing |= {(path.name, flag) for flag in FLAG.findall(node.value) if flag not in known}
    assert missing == set()


def reason(run: Any = None, **fields: Any) -> tuple[str | None, str]:
    found = view_status(a_view(**fields), run or run_of())
    return found["cause"], found["advice"] or ""


def test_most_tie_points_rejected_is_a_contradiction_and_no_lack_of_overlap():
    cause, advice = reason(num_observations=3, num_rejected=290)
    assert cause == "contradicted"
    assert advice.startswith(
        "99 % of its tie points were rejected, as they contradict those of the other images. Check "
    )
    assert "IMAGE,camera=FILE" in advice
    assert "overlap" not in advice
    assert reason(num_observations=0, num_rejected=30)[0] == "contradicted"
    assert reason(num_observations=0, num_rejected=29)[0] == "none"  # too few to say so
    assert reason(num_observations=60, num_rejected=60)[0] == "rejected"
    assert reason(run_of(kind="check", adjustment=None), num_observations=0, num_rejected=30)[0] == "none"
    anywhere = run_of(adjusted(alike=np.array([5.0, 9.0, 9.0])))
    assert reason(anywhere, num_observations=60, num_rejected=290) == (None, "")


NOISY = {"held_out_noise": np.array([9.0, 1.0, 1.0]), "held_out_rms": np.array([4.5, 0.1, 0.1])}


def test_wrong_matches_are_told_from_what_is_off_together():
    anywhere = run_of(adjusted(alike=np.array([5.0, 9.0, 9.0]), **NOISY))
    cause, advice = reason(anywhere, num_observations=60, num_rejected=290)
    assert cause == "wrong_matches"
    assert "83 % of its tie points were rejected; neighbours err in random directions" in advice
    assert "residuals of 4.50 px" in advice
    assert reason(anywhere, num_observations=60, num_rejected=10)[0] == "held_out"


def test_an_image_beside_one_that_contradicts_is_sent_to_it():
    cause, advice = reason(run_of(adjusted(**NOISY), beside={0: 2}))
    assert cause == "beside"
    assert "seen in C, too" in advice


def test_where_tie_points_contradict_is_said_of_the_image_and_not_again_of_the_block():
    run = run_of(adjusted(left=[interval(0, 0.8, 0.0)]))
    cause, advice = reason(run)
    assert cause == "place"
    assert advice.startswith(
        "In rows 100-399 80 % of the tie points disagree with the rest of the image, typically by "
    )
    cause, advice = reason(run, num_observations=60, num_rejected=90)
    assert cause == "rejected"  # it is a part of the image that is off, and so its RPC is its own
    assert "same direction, so it is no noise; most in rows 100-399 (80 %, typically by 2.5 px)" in advice


def test_columns_that_lie_off_over_all_rows_are_no_clouds():
    columns = Interval(0, 0, 100.0, 400.0, 30.0, 0.02, 0.16, False, 0.0)
    for one, told in (
        (columns, "In columns 100-399, over all rows the tie points share a residual of 0.16 px. Check for "
         "detectors or resampling"),
        (replace(columns, share=0.8, by_share=True, apart=2.5), "Check for clouds, water, change there"),
        (replace(columns, axis=1), "Check for clouds, water, change there"),
    ):  # fmt: skip
        cause, advice = reason(run_of(adjusted(left=[one])))
        assert cause == "place"
        assert advice.endswith(told)


@pytest.mark.parametrize(
    ("matched", "cause", "words"),
    [
        ((), "untied", "No tie points lead to the main group of images, and the camera"),
        ((("B", "C"),), "no_overlap", "No pair was selected for matching"),
        ((("A", "C"), ("B", "C")), "untied", "(1 pair with it tried)"),
        ((("A", "C"), ("A", "B")), "untied", "(2 pairs with it tried)"),
    ],
)
def test_an_image_that_nothing_ties_overlapped_or_was_tried_in_vain(matched, cause, words):
    reports = tuple(SimpleNamespace(names=names) for names in matched)
    found, advice = reason(run_of(adjusted(left_out=("A",)), matched=reports))
    assert found == cause
    assert words in advice


def test_no_number_is_no_error_in_pixels():
    cause, advice = reason(rmse_after=None)
    assert cause == "unseen"
    assert "nan" not in advice


def tracks_of(rows: list[tuple[int, int]]) -> Tracks:
    view, point = np.array(rows).T
    return Tracks(view, point, np.zeros((len(rows), 2)), np.ones(len(rows)))


def test_a_view_is_beside_one_whose_tie_points_contradict_where_most_of_its_own_are_seen_there():
    rows = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (0, 3), (2, 3), (0, 4), (1, 4)]
    tracks = tracks_of(rows)
    held = np.isin(tracks.point, [0, 1, 2])
    kept = ~held & ~(tracks.view == 2)  # of view 2 all is cut
    found = SimpleNamespace(inlier=kept, held_out=held, moving=np.zeros(len(rows), bool))
    views = tuple(SimpleNamespace(sensor=None) for _ in range(3))
    run = Run("adjust", views, (), tracks, adjustment=found)  # type: ignore[arg-type]
    assert run.beside == {0: 2, 1: 2}
    calm = replace(run, adjustment=SimpleNamespace(**{**vars(found), "inlier": ~held}))  # type: ignore[arg-type]
    assert calm.beside == {}
    few = np.isin(tracks.point, [1, 2, 4])  # of the first view's three in view 2 is one
    fewer = SimpleNamespace(**{**vars(found), "held_out": few, "inlier": ~few & ~(tracks.view == 2)})
    assert replace(run, adjustment=fewer).beside == {}  # type: ignore[arg-type]
