"""Records: read, written, their schema, and the cells that their values become."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar

import msgspec
import numpy as np
import pytest

from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.select.foreign_camera import FOREIGN_CAMERA
from barpc.ba.terms import TERMS
from barpc.base.errors import listed
from barpc.report.records import Cell, Column, Number, Record, cell_of, column, column_of, json_form, table, value_of
from barpc.report.summary import SCHEMA, published_schema
from barpc.report.summary.block import EXPLANATIONS, MODES
from barpc.report.summary.pairs import OffsetEntry, PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import Count, Share, Side, largest, median, medians, metres

from .made import a_correction, a_pair, a_view


class Part(Record):
    """A part."""

    size: Number = column("How large", "m", "size", ".1f")
    both: tuple[float, float] | None = column("Two", "px", ("one", "other"), ".2f", adjusted=True, default=None)


class Whole(Record):
    """A whole."""

    OWN: ClassVar = {"twice": Column("twice", lambda row: 2 * row.num, ".0f")}

    num: int = column("How many", head="num")
    part: Part | None = column("A part")
    more: tuple[Part, ...] = column("Parts", default=())
    kind: str = column("Which", default="a", enum=["a", "b"])
    share: Share = column("How much", default=0.5)


WHOLE = Whole(3, Part(1.5, (0.25, -1.0)), (Part(None),))
MORE = {"kind": "a", "share": 0.5}
PLAIN = {"num": 3, "part": {"size": 1.5, "both": [0.25, -1.0]}, "more": [{"size": None}], **MORE}


def test_a_record_is_written_without_what_is_optional_and_not_there():
    assert json_form(WHOLE) == PLAIN
    assert json_form(Whole(3, None)) == {"num": 3, "part": None, "more": [], **MORE}


def test_a_record_comes_back_from_its_file_and_passes_over_what_it_does_not_know():
    assert Whole.read({**PLAIN, "new": 1}) == WHOLE
    assert Whole.read({"num": 3, "part": None}) == Whole(3, None)


def test_what_is_not_finite_is_null_and_arrays_are_lists():
    value = {
        1: float("nan"),
        "b": np.array([[1.0, np.inf]]),
        "c": np.float64("nan"),
        "d": np.int32(4),
        "e": (True, "x"),
    }
    assert json_form(value) == {"1": None, "b": [[1.0, None]], "c": None, "d": 4, "e": [True, "x"]}
    assert json_form(float("-inf")) is None
    assert json_form(Part) == str(Part)

    @dataclass
    class Other:
        shown: int | None = None
        _hidden: int = 1

    assert json_form(Other()) == {"shown": None}  # of no record all fields are kept


def test_what_a_file_may_hold_is_what_is_declared():
    for wrong in (
        {"num": 3}, {"num": "3", "part": None}, {"num": True, "part": None}, {"num": 3.5, "part": None}, [], None,
        {"num": 3, "part": {"size": 1.5, "both": [1.0]}}, {"num": 3, "part": {"size": "x"}},
        {"num": 3, "part": None, "more": [1]},
        {"num": 3, "part": None, "kind": "c"}, {"num": 3, "part": None, "share": 1.5},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"^[A-Z]"):
            Whole.read(wrong)
    found = msgspec.json.schema(Whole)["$defs"]
    assert found["Whole"]["required"] == ["num", "part"]
    assert found["Part"]["properties"]["size"]["description"] == "How large [m]."
    assert sorted(found["Whole"]["properties"]["kind"]["enum"]) == ["a", "b"]


UNITS = {"px", "m", "deg", "MB", "m above the ellipsoid", "px/px", "urad", "ms", "nats"}


def test_what_is_said_of_a_value_ends_with_its_unit():
    parts = [part for one in published_schema()["$defs"].values() for part in one["properties"].values()]
    texts = [part["description"] for part in parts]
    assert len(texts) > 100
    for text in texts:
        words, unit = re.fullmatch(r"(.*?)(?: \[([^\]]*)\])?\.", text).groups()
        assert unit is None or unit in UNITS, text
        assert words not in UNITS, text


def test_the_version_of_the_file_is_three():
    assert SCHEMA == 3
    assert published_schema()["$defs"]["Summary"]["properties"]["schema"]["enum"] == [3]


def test_kinds_of_the_file_are_those_of_the_adjustment():
    """Records name them of their own: reading a run loads no adjustment."""
    assert list(MODES) == list(MOTIONS)
    told = [words.format("25 cm") for words in MODES.values()]
    assert all("25 cm" in words and len(words) > 30 for words in told)
    assert list(EXPLANATIONS) == [*TERMS, FOREIGN_CAMERA]


def test_columns_are_fields_parts_and_own_ones():
    found = table("k", "c", [WHOLE, Whole(4, None)], Whole, "num twice part.size part.both")
    assert found.columns == ["num", "twice", "size [m]", "one [px]", "other [px]"]
    assert found.texts[1:] == [["3", "6", "1.5", "0.25", "-1.00"], ["4", "8", "-", "-", "-"]]
    assert table("k", "c", [WHOLE], Whole, "num part.both", adjusted=False).columns == ["num"]
    assert column_of(Whole, "part.both").adjusted
    assert value_of(Whole(1, None), "part.size") is None
    assert value_of(WHOLE, "part.size") == 1.5


@pytest.mark.parametrize(
    ("value", "form", "cell"),
    [
        (None, "", Cell("-", "-", "name")),
        (None, ".1f", Cell("-", 1e300)),
        ((None, 1.0), ".1f", Cell("-", 1e300)),
        ("x", "", Cell("x", "x", "name")),
        ("why there is none", ".1f", Cell("why there is none", 1e301)),
        ((1.0, -2.25), ".1f", Cell("1.0, -2.2", 2.25)),
        (0.0, ".3f", Cell("0", 0.0)),
        (1.23456789, ".1f", Cell("1.2", 1.23457)),
        (7, "", Cell("7", 7.0)),
        (Cell("a", 1.0), ".1f", Cell("a", 1.0)),
    ],
)
def test_a_value_as_a_cell(value, form, cell):
    assert cell_of(value, form) == cell


# --- words ------------------------------------------------------------------------------------------------


def test_small_words():
    assert largest([1.0, 3.0, 2.0]) == 3.0
    assert largest([1.0, None]) is None
    assert largest([]) is largest(None) is None
    assert listed(list("abc"), 3) == "a, b, c"
    assert listed(list("abcd"), 3) == "a, b, c and 1 more"
    assert listed([str(k) for k in range(12)]).endswith("9 and 2 more")
    assert median([None, 3.0, float("inf"), 1.0]) == 2.0
    assert np.isnan(median([None]))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.0 m"),
        (0.999, "1.0 m"),
        (0.01, "1.0 cm"),
        (0.00999, "1.0 cm"),
        (0.0001, "0.1 mm"),
        (-3.0, "-3.0 m"),
        (0.001, "1.0 mm"),
        (1234.5, "1200 m"),
        (-0.02, "-2.0 cm"),
        (0.0, "0.0 mm"),
    ],
)
def test_lengths_change_their_unit_at_one(value, text):
    assert metres(value) == text


def test_a_median_is_that_of_each_group():
    group = np.array([2, 0, 2, 2, 0, 2, 4])
    found = medians(np.array([9.0, 1.0, 1.0, 3.0, 2.0, 5.0, 7.0]), group, 6)
    np.testing.assert_equal(found, [1.5, np.nan, 4.0, np.nan, 7.0, np.nan])


# --- columns of images and pairs --------------------------------------------------------------------------


def test_a_pair_shows_its_offsets_as_they_were_before_and_after():
    pair = a_pair(epipolar_before=OffsetEntry(-0.3, 0.2, 0.4, 9), epipolar_after=None, beaten=("x", "y"))
    assert pair.offset_rms == (0.4, None)
    assert a_pair(epipolar_before=None).offset_rms == (None, 0.1)
    cells = table("k", "c", [pair], PairEntry, "pair before after beaten").rows[0]
    assert [cell.text for cell in cells] == ["A - B", "-0.300 ± 0.200", "-", "x; y"]
    assert [cell.key for cell in cells][1:3] == [0.3, 1e300]


def test_an_image_shows_shares_in_percent():
    view = a_view(num_observations=30, num_rejected=10, tie_coverage=0.5, correction=a_correction())
    cells = table("k", "c", [view], ViewEntry, "verdict lost tie_coverage").rows[0]
    assert [(cell.text, cell.key) for cell in cells] == [("adjusted", 0), ("25.0", 25.0), ("50%", 0.5)]
    none = table(
        "k", "c", [a_view(num_observations=0)], ViewEntry, "camera_center.altitude_m largest fit.coverage"
    ).rows[0]
    assert [cell.text for cell in none] == ["-"] * 3
    every = f"{ViewEntry.PAGE} {ViewEntry.TERMINAL}"
    checked = table("k", "c", [view], ViewEntry, every, adjusted=False).columns
    assert not {"after [px]", "shift col, row [px]"} & set(checked)
    pairs = table("k", "c", [a_pair()], PairEntry, PairEntry.PAGE, adjusted=False).columns
    assert "now [px]" in pairs
    assert not {"before [px]", "after [px]"} & {*pairs, *checked}


def test_what_numbers_a_file_may_hold():
    for kind, held, beyond in ((Count, [0, 1], [-1]), (Side, [1], [0]), (Share, [0, 1], [-1e-9, 1 + 1e-9])):
        assert [msgspec.convert(value, kind) for value in held] == held
        for value in beyond:
            with pytest.raises(msgspec.ValidationError):
                msgspec.convert(value, kind)
    schema = {name: part["properties"] for name, part in published_schema()["$defs"].items()}
    gcp, view = schema["GcpEntry"], schema["ViewEntry"]
    assert (gcp["lon"]["minimum"], gcp["lon"]["maximum"]) == (-540, 540)
    assert (gcp["lat"]["minimum"], gcp["lat"]["maximum"]) == (-90, 90)
    assert (schema["Summary"]["views"]["minItems"], view["name"]["minLength"]) == (1, 1)
    motion = schema["ModeEntry"]["motion_m"]
    assert (motion["minItems"], motion["maxItems"]) == (7, 10)  # those of runs before have seven


def test_a_legend_says_what_columns_mean_and_columns_of_one_meaning_stand_together():
    found = table("t", "A caption", [WHOLE], Whole, "num part.size part.both twice")
    assert found.columns == ["num", "size [m]", "one [px]", "other [px]", "twice"]
    assert found.legend == [("size [m]", "How large"), ("one [px], other [px]", "Two")]


@pytest.mark.parametrize("kind", [ViewEntry, PairEntry])
def test_every_column_of_images_and_pairs_but_their_names_and_verdict_has_a_meaning(kind):
    for words in (kind.PAGE, *(getattr(kind, name, "") for name in ("CORRECTIONS", "PLACES", "DECISIONS", "FITS"))):
        empty = [name for name in words.split()[1:] if not column_of(kind, name).text]
        assert empty in ([], ["verdict", "wrong"])
