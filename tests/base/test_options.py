"""One layer of options: what is declared beside a field is what every path refuses, prints and writes down."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args, get_origin

import click
import numpy as np
import pytest
from click.testing import CliRunner
from jsonschema import Draft202012Validator

import barpc
from barpc.base.declarations import Declared, Options, Rule, checked, declared, schema, with_values
from barpc.base.errors import InputError, UsageError
from barpc.base.options import PAPER, AdjustOptions, FitOptions, RunOptions, TieOptions, read_options
from barpc.base.safe_io import MB
from barpc.base.verb_options import ConvertOptions, DsmOptions, OrthoOptions, RefitOptions, VerifyOptions
from barpc.cli import cli
from barpc.cli.flags import ADJUSTMENT, RUN, TIE, flag, flag_name, options_of_flags

TABLES: dict[str, type[Options]] = {
    "": RunOptions, "tie": TieOptions, "adjust": AdjustOptions, "fit": FitOptions
}  # fmt: skip
FLAGS = {target: flag_name(target) for target in (*TIE, *ADJUSTMENT, *RUN, "fit.tolerance")}
FIELDS = [
    (table, name, one)
    for table, record in TABLES.items()
    for name, one in declared(record).items()
    if name not in TABLES
]
NAN = float("nan")


def whole(value: Any, one: Declared) -> Any:
    """A single value as the field holds it: the first of a list or a table, the others as they are by default."""
    if get_origin(one.kind) is tuple:
        return (value, *one.default[1:])
    return {"view_00": value} if get_origin(one.kind) is Mapping else value


def element(one: Declared) -> Any:
    """The type of a single value."""
    return get_args(one.kind)[-1 if get_origin(one.kind) is Mapping else 0] if get_origin(one.kind) in (
        tuple,
        Mapping,
    ) else one.kind  # fmt: skip


def wrong_values(one: Declared) -> Iterator[Any]:
    """Values of another type, out of range, and what is no number."""
    kind, rule = element(one), one.rule
    yield from (object(), whole(NAN, one), whole(float("inf"), one), whole(object(), one), [[]])
    if kind is bool:
        yield from (1, 0, "true", 1.0)
    elif kind in (int, float):
        yield from (whole(value, one) for value in ("1", True, 10**400, -(10**17)))
        bounds = [(rule.least, -1), (rule.above, 0), (rule.most, 1), (rule.below, 0)]
        step = 1 if kind is int else 1e-6
        yield from (whole(kind(bound + step * sign), one) for bound, sign in bounds if bound is not None)
        if kind is int:
            yield whole(2.5, one)
    else:
        yield from (whole(value, one) for value in (1, True, b"guided", ["txt"]))
    if rule.choices(kind) or rule.choices(one.kind):
        yield from (whole(value, one) for value in ("", "chebychev", "TXT"))
    if not one.optional:
        yield None


def toml(value: Any) -> str | None:
    """A value in an options file; None where TOML cannot spell it."""
    if isinstance(value, (list, tuple)):
        inner = [toml(item) for item in value]
        return None if None in inner else f"[{', '.join(str(item) for item in inner)}]"
    if isinstance(value, dict):
        return f"{{ view_00 = {toml(value['view_00'])} }}" if toml(value["view_00"]) else None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    return str(value) if isinstance(value, (int, float)) else None


def one_line(error: BaseException, name: str) -> None:
    assert name in str(error)
    assert "\n" not in str(error)
    assert len(str(error)) < 400 or "1000000000" in str(error)


@pytest.mark.few(18)
@pytest.mark.parametrize(("table", "name", "one"), FIELDS, ids=[f"{t}.{n}" if t else n for t, n, _ in FIELDS])
def test_what_a_field_cannot_hold_is_refused_on_every_path(
    table: str, name: str, one: Declared, tmp_path: Path
) -> None:
    record, path = TABLES[table], tmp_path / "options.toml"
    option = FLAGS.get(f"{table}.{name}".lstrip("."))
    verb = "fit" if f"{table}.{name}" == "fit.tolerance" else "adjust"
    tried = 0
    for wrong in wrong_values(one):
        with pytest.raises(InputError) as caught:
            record(**{name: wrong})
        one_line(caught.value, name)
        with pytest.raises(InputError) as caught:
            replace(record(), **{name: wrong})  # type: ignore[type-var]
        one_line(caught.value, name)
        if (text := toml(wrong)) is not None:
            path.write_text(f"[{table}]\n{name} = {text}\n" if table else f"{name} = {text}\n")
            with pytest.raises(InputError) as caught:
                read_options(path)
            one_line(caught.value, name)
            assert str(path) in str(caught.value)
            tried += 1
        number = wrong[0] if isinstance(wrong, (list, tuple)) and wrong else wrong
        if option and element(one) is not str and isinstance(number, (int, float, str)) and text:
            if element(one) is bool:
                continue  # it takes no value
            if isinstance(number, str) and number.isdecimal():
                continue  # on a command line every number is a text
            given = ["SOURCE"] if verb == "fit" else ["a.tif", "-o", str(tmp_path / "out")]
            found = CliRunner().invoke(cli, [verb, *given, f"{option}={number}"])
            assert isinstance(found.exception, (click.UsageError, SystemExit, InputError)), (number, found)
            assert found.exit_code != 0
            assert name in found.output + str(found.exception), number
    assert tried or one.kind is str


@pytest.mark.parametrize(("table", "name", "one"), FIELDS, ids=[f"{t}.{n}" if t else n for t, n, _ in FIELDS])
def test_what_a_field_can_hold_is_taken_as_it_is(table: str, name: str, one: Declared) -> None:
    """The default, the choices, the bounds that belong to the range; numpy's numbers and paths become plain."""
    record, rule, kind = TABLES[table], one.rule, element(one)
    given = [one.default, *rule.choices(kind), *rule.choices(one.kind)]
    given += [kind(bound) for bound in (rule.least, rule.most) if bound is not None]
    if kind is float:
        given += [np.float64(0.5), np.float32(0.5), 1 if rule.holds(1) else 0.5]
    elif kind is int:
        given += [np.int64(rule.least or 1)]
    elif kind is str and not rule.choices(kind):
        words = {"url": ["s3://bucket/x"], "auto|off|rows": ["off", "1500", "2e3"]}
        given += words.get(rule.unit, ["view_00", Path("view_00")])
    rest = {"dem": "dem.tif"} if name in ("geoid", "reference", "reference_sigma") else {}
    rest |= {"reference": ("ortho.tif",)} if name == "reference_sigma" else {}
    rest |= {"add_to": "earlier"} if name == "update" else {}
    for value in given:
        value = value if isinstance(value, type(one.default)) and value is one.default else whole(value, one)
        if name == "angles":
            value = (value[0], 180.0)
        made = getattr(record(**{name: value, **rest}), name)
        first = made[0] if isinstance(made, tuple) and made else made
        first = first.get("view_00", 1.0) if isinstance(first, dict) else first
        assert first in (None, ()) or type(first) in (bool, int, float, str)
        assert record(**{name: made, **rest}) == record(**{name: value, **rest})


def test_there_are_few_and_each_has_a_meaning() -> None:
    assert len(FIELDS) <= 58
    for table, name, one in FIELDS:
        assert len(one.rule.help) > 15, (table, name)
        if element(one) is float:
            assert one.rule.least is not None or one.rule.above is not None, (table, name)
        for record in TABLES.values():
            assert "Parameters\n----------\n" in (record.__doc__ or "")


@pytest.mark.parametrize("target", FLAGS)
def test_a_flag_says_what_is_declared(target: str) -> None:
    table, _, name = target.rpartition(".")
    one = declared(TABLES[table])[name]
    option = flag(target)(lambda: None).__click_params__[0]  # type: ignore[attr-defined]
    assert option.help.startswith(one.rule.help)
    names, text = option.get_help_record(click.Context(click.Command("adjust")))
    if one.rule.unit:
        assert one.rule.unit.upper() in names
    for choice in () if one.rule.rows else one.rule.choices(one.kind):
        assert choice in names
    if one.default not in (None, (), False):
        assert f"default: {one.default[0] if isinstance(one.default, tuple) else one.default}" in text


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "o.toml"
    path.write_text('add_to = "earlier"\n[tie]\nband = 2\nsearch = 9\n[adjust]\nfixed = ["a"]\n')
    flags = {"flag_tie_band": 3, "flag_adjust_fixed": ("b", "c"), "flag_matches": (), "flag_gcp": ()}
    found = options_of_flags(flags, str(path))
    assert (found.tie.band, found.tie.search, found.adjust.fixed) == (3, 9.0, ("b", "c"))
    assert (found.add_to, found.matches, found.gcp) == ("earlier", (), ())


def test_the_schema_and_the_records_agree(tmp_path: Path) -> None:
    """On the defaults, on every bound and beyond: the schema is the declarations in another language."""
    written = schema(RunOptions)
    json.dumps(written)
    validator = Draft202012Validator(written)
    assert validator.is_valid({})
    assert not validator.is_valid({"colour": 3})
    for table, name, one in FIELDS:
        for wrong in wrong_values(one):
            if toml(wrong) is None or "inf" in str(wrong) or "nan" in str(wrong) or "0000000" in str(wrong):
                continue  # not JSON, or beyond what a schema says
            wrong = json.loads(json.dumps(wrong))
            assert not validator.is_valid({table: {name: wrong}} if table else {name: wrong}), (name, wrong)
        if one.default is not None and not one.rule.only:  # no options file has it
            plain = json.loads(json.dumps(one.default))
            assert validator.is_valid({table: {name: plain}} if table else {name: plain}), name


def test_a_standard_deviation_may_be_small_and_is_not_zero() -> None:
    for name in ("dem_sigma", "dem_bias_sigma", "sigma_attitude", "sigma_position"):
        assert getattr(AdjustOptions(**{name: 1e-3}), name) == 1e-3
        with pytest.raises(InputError, match=f"{name} must be a number above 0"):
            AdjustOptions(**{name: 0.0})


def test_the_altitudes_of_a_surface_begin_with_the_lower_one() -> None:
    assert DsmOptions(alt=(300.0, 300.1)).alt == (300.0, 300.1)
    for alt in ((300.0, 300.0), (300.0, 200.0)):
        with pytest.raises(InputError, match="alt: the lower altitude comes first, found"):
            DsmOptions(alt=alt)


def test_only_constant_rotations_without_splines_that_were_asked_for_are_plain() -> None:
    """Such a run reports what more unknowns would follow instead of following it."""
    plain = {(drift, jitter): AdjustOptions(drift=drift, jitter=jitter).is_plain for drift, jitter in [
        (0, "auto"), (1, "auto"), (2, "auto"), (0, "500"), (0, "off"),
    ]}  # fmt: skip
    assert [given for given, is_plain in plain.items() if is_plain] == [(0, "auto")]


def test_records_print_what_differs_from_the_defaults() -> None:
    for record in TABLES.values():
        assert repr(record()) == f"{record.__name__}()"
    many = RunOptions(
        adjust=AdjustOptions(dem_sigma=3),
        gcp=tuple(f"points_{i}.gcp" for i in range(99)),
        keep_going=True,
    )
    assert repr(many).startswith("RunOptions(adjust=AdjustOptions(dem_sigma=3.0), keep_going=True, gcp=(")
    assert len(repr(many)) < 250
    assert eval(repr(AdjustOptions(drift=0, fixed=("a",)))) == AdjustOptions(drift=0, fixed=("a",))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"colour": 3}, r"here: unknown option 'colour'; known are tie, adjust"),
        ({"tie": {"colour": 3}}, r"here \[tie\]: unknown option 'colour'; known are band"),
        ({"tie": 3}, r"here: \[tie\] must be a table, found 3"),
        (
            {"fit": {"space": "images"}},
            r"here \[fit\]: space 'images' is not one of image, ground",
        ),
        (
            {"fit": {"method": "minimax"}},
            r"here \[fit\]: method 'minimax' is not one of auto, [^;]*; removed: it minimised the largest error, "
            r"`gauss-newton` minimises",
        ),
        ({"fit": {"method": "vendor-denominators"}}, "removed: it kept the denominators of .*, `auto` fits them$"),
        ({"fit": {"method": "minimal"}}, r"'minimal' is not one of auto, ridge, gauss-newton, lcurve-joint$"),
        ({"adjust": {"loss": "linear"}}, r"here \[adjust\]: unknown option 'loss'"),
        ({"rpc_formats": ["txt", "doc"]}, r"rpc_formats .*'doc' is not one of txt, "),
        ({"adjust": {"dem_sigma": -1}}, r"here \[adjust\]: dem_sigma must be a number above 0"),
        ({"adjust": {"center_method": "foo"}}, r"here \[adjust\]: unknown option 'center_method'"),
        ({"adjust": {"model": "shift", "drift": 1}}, "drift 1 needs a model with a rotation"),
        ({"adjust": {"jitter": "5e-324"}}, "jitter '5e-324' is not auto, off or a number of rows"),
        ({"adjust": {"jitter": "1e31"}}, "jitter '1e31' is not auto, off or a number of rows"),
        ({"tie": {"angles": [30.0, 29.9]}}, r"angles: the smallest comes first, found \(30.0, 29.9\)"),
        ({"adjust": {"detectors": [5, 4]}}, r"detectors: columns ascend, found \[5.0, 4.0\]"),
        ({"adjust": {"detectors": [4, 4]}}, r"detectors: columns ascend, found \[4.0, 4.0\]"),
        ({"update": True}, "update is given without add_to"),
        ({"geoid": "egm96"}, "geoid is given without dem or ground points"),
        ({"reference": ("a.tif",)}, "reference is given without dem"),
        ({"reference_sigma": 2.0}, "reference_sigma is given without reference"),
        ({"matches_only": True}, "matches_only is given without matches"),
        ({"matches": ("a",), "matches_only": True, "aoi": "a"}, "aoi is given with matches_only"),
        ({"matches": ("a",), "matches_only": True, "overlap_list": "a"}, "overlap_list is given with matches_only"),
        ({"allow_remote": ("a/b",)}, "allow_remote 'a/b' is no HOST, HOST:PORT or s3://BUCKET"),
        (
            {"fit": {"grid": [4, 4, 2**24]}},
            r"grid \[4, 4, 16777216\]: 268435456 control points, at most 26843545",
        ),
    ],
)
def test_a_message_says_where_and_what(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        with_values(RunOptions(), values, "here")


def test_what_goes_together_is_taken() -> None:
    dem = {"dem": ("d.tif",)}
    for values in (
        {"tie": {"angles": [30.0, 30.0]}}, {"adjust": {"detectors": [4, 5]}}, {"update": True, "add_to": "run"},
        {"adjust": {"jitter": "0.5"}},
        {"geoid": "egm96", **dem}, {"geoid": "egm96", "gcp": ("a",)}, {"geoid": "egm96", "check_points": ("a",)},
        {"reference": ("a.tif",), "reference_sigma": 2.0, **dem}, {"matches": ("a",), "matches_only": True},
        {"matches": ("a",), "aoi": "a", "overlap_list": "b"}, {"allow_remote": ("a.org", "a.org:80", "s3://b")},
    ):  # fmt: skip
        with_values(RunOptions(), values, "here")
    assert not ConvertOptions().cut
    assert all(ConvertOptions(**one).cut for one in ({"window": (1, 2, 3, 4)}, {"bbox": (1, 2, 3, 4)}, {"aoi": "a"}))
    assert VerifyOptions(expect="aF" * 32).expect == "aF" * 32
    for wrong in ("a" * 63, "a" * 65, "g" * 64):
        with pytest.raises(UsageError, match="a root has 64 hexadecimal digits"):
            VerifyOptions(expect=wrong)


def test_the_names_are_public_and_cost_no_numpy() -> None:
    assert {"RunOptions", "AdjustOptions", "TieOptions", "FitOptions", "AdjustResult", "check"} <= set(barpc.__all__)
    assert barpc.AdjustOptions is AdjustOptions
    code = (
        "import sys, barpc\nfrom barpc.cli import main\n"
        "print(barpc.RunOptions(tie=barpc.TieOptions(search=5)))\n"
        "try:\n    main(['adjust', '--help'])\nexcept SystemExit:\n    pass\n"
        "assert 'numpy' not in sys.modules, [m for m in sys.modules if 'barpc' in m]\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--reference FILE" in done.stdout


def test_what_nobody_chose_is_as_the_manual_says() -> None:
    assert AdjustOptions().noise_floor == 0.02


def test_the_model_of_the_paper_is_constant() -> None:
    expected = {"model": "rotation+translation", "center": "projective", "drift": 0, "jitter": "off"}
    assert PAPER["adjust"] == expected


def test_bounds_are_where_they_are_said_to_be() -> None:
    assert AdjustOptions(min_convergence=180.0).min_convergence == 180.0
    with pytest.raises(InputError, match="min_convergence"):
        AdjustOptions(min_convergence=180.5)
    assert checked("count", int, Rule("A number."), 2**53 - 1) == 2**53 - 1
    with pytest.raises(InputError, match="count"):
        checked("count", int, Rule("A number."), 2**53)


@pytest.mark.parametrize("text", [
    "a.b.c.d.e.f.g.h.i.j.k = 1", "[a.b.c.d.e.f.g.h.i.j.k]", "[[ a . b.c.d.e.f.g.h.i.j.k ]]",
    "x = {a.b.c.d.e.f.g.h.i.j.k=1}",
    '"a"."b".c.\'d\'.e.f.g.h."i.x".j.k = 1', "a = 1 # '\nb.b.c.d.e.f.g.h.i.j.k = 1", "a" + ".a" * 20000 + " = 1",
])  # fmt: skip
def test_a_key_of_many_parts_is_refused_before_it_is_parsed(tmp_path, text) -> None:
    """tomllib takes 1.7 GB for 40 kB of one, and ten seconds."""
    path = tmp_path / "o.toml"
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(InputError, match=r"o\.toml: not an options file .*: a key of more than 10 parts"):
        read_options(path)
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize("text", [
    f"{'grids = true':<20}# " + "a." * 40, "aoi = '" + "../" * 40 + "a.b'", f'aoi = "{"a." * 40}tif"',
    f'aoi = """\n{"a." * 40}\n"""', f"aoi = \'\'\'{'a.' * 40}\'\'\'", f'aoi = "\\"{"a." * 40}"',
])  # fmt: skip
def test_dots_that_part_no_key_are_no_parts(tmp_path, text) -> None:
    path = tmp_path / "o.toml"
    path.write_text(text)
    tomllib.loads(text)
    assert read_options(path) is not None


@pytest.mark.parametrize("text", [
    "a" * (1 << 20), "a-" * (1 << 19), '"' * (1 << 20), "'\"" * (1 << 19), "a." * (1 << 19),
    '"""' + "\\" * (1 << 19), "a.b.c.d.e.f.g.h.i " * 50000, "#\n" * (1 << 19),
])  # fmt: skip
def test_parts_are_counted_in_a_time_that_grows_with_the_text(tmp_path, text) -> None:
    (tmp_path / "o.toml").write_text(text[: MB - 1])
    start = time.process_time()
    with contextlib.suppress(InputError):
        read_options(tmp_path / "o.toml")
    assert time.process_time() - start < 3.0


@pytest.mark.parametrize(
    ("record", "values", "held"),
    [
        (ConvertOptions, {"move": np.array([1, 2, 3])}, (1.0, 2.0, 3.0)),
        (ConvertOptions, {"window": np.array([1, 2, 3, 4])}, (1, 2, 3, 4)),
        (ConvertOptions, {"bbox": [5, np.float32(43), 6, 44]}, (5.0, 43.0, 6.0, 44.0)),
        (ConvertOptions, {"transform": Path("t.txt")}, "t.txt"),
        (OrthoOptions, {"dem": Path("a.tif")}, ("a.tif",)),
        (OrthoOptions, {"dem": [Path("a.tif"), "b.tif"]}, ("a.tif", "b.tif")),
        (OrthoOptions, {"gsd": np.float64(2)}, 2.0),
        (RefitOptions, {"alt_range": np.array([0, 300])}, (0.0, 300.0)),
        (DsmOptions, {"alt": (np.int64(0), 300)}, (0.0, 300.0)),
    ],
)
def test_keywords_of_a_verb_are_what_numpy_and_paths_give(record, values, held) -> None:
    (name,) = values
    found = getattr(with_values(record(), values), name)
    assert found == held
    assert [type(one) for one in np.atleast_1d(np.array(found, object))] == [
        type(one) for one in np.atleast_1d(np.array(held, object))
    ]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"window": (1, 2, 3)}, r"window must be 4 values, each a whole number \[px\], found \(1, 2, 3\)"),
        ({"window": (1.5, 2, 3, 4)}, r"window must be a whole number \[px\], found 1.5"),
        ({"move": np.zeros((2, 3))}, "move must be 3 values"),
        ({"move": (0, 0, 22000)}, r"move must be a number above -22000 and below 22000 \[m\], found 22000"),
        ({"bbox": "abcd"}, r"bbox must be 4 values, each a number \[deg\], found 'abcd'"),
        ({"images": "none"}, "images 'none' is not one of vrt, copy"),
        ({"alt": float("nan")}, r"alt must be a number \[m\], found nan"),
        ({"dem": 3}, "dem must be a list, each a file, found 3"),
    ],
)
def test_keywords_of_a_verb_are_refused_by_name(values, message) -> None:
    with pytest.raises(InputError, match=f"^convert: {message}"):
        with_values(ConvertOptions(), values, "convert")
    with pytest.raises(UsageError, match=r"^convert: give either --move or --transform"):  # of wrong usage: exit code 2
        with_values(ConvertOptions(), {"move": (1, 2, 3), "transform": "t.txt"}, "convert")
