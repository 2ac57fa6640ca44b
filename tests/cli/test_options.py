"""Flags made of declarations: what they take, refuse and say of themselves, and the order in which they count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from barpc.base.errors import InputError
from barpc.base.options import AdjustOptions, FitOptions, RunOptions, TieOptions
from barpc.cli import cli
from barpc.cli.adjust import adjust
from barpc.cli.flags import field_of, flag, flag_name, given_flags, image_paths, jobs_option, options_of_flags


def given(target: str, *words: str) -> Any:
    """The value of a flag on a command line; the text of the refusal."""
    found: list[Any] = []

    @click.command()
    @flag(target)
    def verb(**flags: Any) -> None:
        found.extend(flags.values())

    said = CliRunner().invoke(verb, list(words))
    return found[0] if found else said.output


def option_of(target: str) -> click.Option:
    @click.command()
    @flag(target)
    def verb(**_: Any) -> None: ...

    (option,) = verb.params
    assert isinstance(option, click.Option)
    return option


@pytest.mark.parametrize(
    ("target", "words", "value"),
    [
        ("fit.tolerance", (), None),
        ("fit.tolerance", ("--tolerance", "0.25"), 0.25),
        ("overwrite", (), None),
        ("overwrite", ("--overwrite",), True),
        ("adjust.model", ("--model", "shift"), "shift"),
        ("adjust.drift", ("--drift", "2"), 2),
        ("rpc_formats", ("--rpc-format", "txt, geom"), ("txt", "geom")),
        ("rpc_formats", (), None),
        ("gcp", ("--gcp", "a", "--gcp", "b"), ("a", "b")),
        ("gcp", (), None),
        ("dem", ("--dem", "a.tif"), ("a.tif",)),
        ("dem", ("--dem", "a.tif", "--dem", "b.tif"), ("a.tif", "b.tif")),
        ("dem", (), None),
    ],
)
def test_a_flag_is_of_the_field_s_type(target: str, words: tuple[str, ...], value: Any) -> None:
    found = given(target, *words)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("fit.tolerance", ("--tolerance", "x")),
        ("fit.tolerance", ("--tolerance", "-1")),
        ("fit.tolerance", ("--tolerance", "nan")),
        ("adjust.drift", ("--drift", "1.5")),
        ("adjust.model", ("--model", "nothing")),
        ("rpc_formats", ("--rpc-format", "txt,doc")),
    ],
)
def test_what_the_field_cannot_hold_is_wrong_usage(target: str, words: tuple[str, ...]) -> None:
    assert "Error: Invalid value for" in given(target, *words)


def test_a_flag_says_its_default_bounds_and_choices() -> None:
    tolerance = field_of("fit.tolerance")
    text = str(option_of("fit.tolerance").help)
    assert text.startswith(tolerance.rule.help)
    assert f"[default: {tolerance.default}; above 0]" in text
    model = option_of("adjust.model")
    assert model.metavar == "[auto|rotation+translation|rotation|translation|shift|shift-drift|affine]"
    assert "[default: auto]" in str(model.help)
    formats = option_of("rpc_formats")
    assert (formats.metavar, formats.multiple) == ("NAMES", False)
    assert "commas between.  [default: txt]" in str(formats.help)
    gcp = option_of("gcp")
    assert gcp.multiple
    assert str(gcp.help).endswith("(repeatable)")
    assert "default" not in str(option_of("dem").help)
    assert option_of("overwrite").is_flag


def test_a_shell_completes_the_choices() -> None:
    option = option_of("adjust.model")
    found = option.shell_complete(click.Context(click.Command("x")), "shift")
    assert [getattr(one, "value", one) for one in found] == ["shift", "shift-drift"]


@pytest.mark.parametrize(
    ("target", "name"), [("rpc_formats", "--rpc-format"), ("adjust.jitter", "--jitter"), ("aoi", "--aoi")]
)
def test_a_flag_has_the_field_s_name(target: str, name: str) -> None:
    assert flag_name(target) == name


@pytest.mark.parametrize(
    ("text", "jobs"),
    [("1", 1), ("8", 8), ("9999", 9999), ("tcp://host:8786", "tcp://host:8786"), ("0", None), ("10000", None),
     ("-1", None), ("", None), ("2.0", None), ("host", None)],
)  # fmt: skip
def test_jobs_are_a_number_or_an_address(text: str, jobs: Any) -> None:
    found = list[Any]()
    said = CliRunner().invoke(jobs_option(click.Command("x", callback=lambda jobs: found.append(jobs))), ["-j", text])
    assert found == ([] if jobs is None else [jobs])
    assert ("is no number of processes, and no address" in said.output) == (jobs is None)


def test_a_list_of_images_is_read_behind_those_of_the_command_line(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("# two images\n\n  a.tif \nhttps://host/b.tif\n/c.tif\n   \n")
    assert image_paths(("x.tif",), str(path), keep_going=True) == [
        "x.tif",
        str(tmp_path / "a.tif"),
        "https://host/b.tif",
        "/c.tif",
    ]
    assert image_paths(("x.tif", "y.tif"), None) == ["x.tif", "y.tif"]
    assert image_paths((), None) == []


def test_paths_of_a_list_count_from_its_folder_and_a_missing_one_is_named_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lists").mkdir()
    (tmp_path / "b.tif").touch()  # of the same name in the current folder: not meant
    for name in ("a.tif", "d,e.tif"):
        (tmp_path / "lists" / name).touch()
    monkeypatch.chdir(tmp_path)
    listed = tmp_path / "lists" / "l.txt"
    listed.write_text(f"# x\na.tif\n{tmp_path}/b.tif\n../b.tif,band=2\nd,e.tif,band=1\n*.tif\n")
    assert image_paths((), "lists/l.txt") == [
        "lists/a.tif",
        f"{tmp_path}/b.tif",
        "lists/../b.tif,band=2",
        "lists/d,e.tif,band=1",
        "lists/*.tif",
    ]
    for missing in ("b.tif", "b.tif,band=2", "*.jp2"):
        listed.write_text(f"a.tif\n\n{missing}\n")
        with pytest.raises(InputError) as error:
            image_paths((), "lists/l.txt")
        said = f"lists/l.txt, line 3: lists/{missing.removesuffix(',band=2')}: no such file"
        assert str(error.value) == f"{said}; relative paths count from the list's folder, {tmp_path / 'lists'}"
        assert image_paths((), "lists/l.txt", keep_going=True) == ["lists/a.tif", f"lists/{missing}"]


def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "o.toml"
    path.write_text('overwrite = true\n[tie]\nband = 7\n[adjust]\nmodel = "shift"\n')
    assert options_of_flags({}, None) == RunOptions()
    read = options_of_flags({}, str(path))
    assert (read.overwrite, read.tie.band, read.adjust.model) == (True, 7, "shift")
    flags = {
        "flag_tie_band": 9,
        "flag_adjust_model": None,
        "flag_adjust_jitter": "off",
        "flag_overwrite": None,
        "flag_fit_tolerance": 0.5,
        "flag_dem": "d.tif",
        "other": 3,
    }
    found = options_of_flags(flags, str(path))
    assert (found.tie.band, found.adjust.model, found.adjust.jitter) == (9, "shift", "off")
    assert (found.overwrite, found.fit.tolerance, found.dem) == (True, 0.5, ("d.tif",))
    alone = options_of_flags(flags, None)
    assert (alone.tie, alone.adjust) == (TieOptions(band=9), AdjustOptions(jitter="off"))
    assert options_of_flags({"flag_adjust_drift": 0}, None).adjust.drift == 0  # 0 is a value
    assert given_flags({"alt": 0.0, "dem": None, "overwrite": False}) == {"alt": 0.0, "overwrite": False}
    with pytest.raises(InputError, match="command line"):
        options_of_flags({"flag_fit_tolerance": -1.0}, None)


def test_one_word_gives_the_paper_s_method_and_the_file_and_flags_win_over_it(tmp_path: Path) -> None:
    whole = options_of_flags({"paper": True}, None)
    told = whole.adjust
    assert (told.model, told.center, told.drift, told.jitter) == ("rotation+translation", "projective", 0, "off")
    assert (whole.fit.method, whole.fit.space) == ("lcurve-joint", "ground")
    assert (whole.tie, replace(whole, adjust=AdjustOptions(), fit=FitOptions())) == (TieOptions(), RunOptions())
    file = tmp_path / "a.toml"
    file.write_text("[adjust]\nnoise_floor = 0.03\n")
    mixed = options_of_flags({"paper": True, "flag_adjust_drift": 1}, str(file))
    assert (mixed.adjust.noise_floor, mixed.adjust.drift, mixed.adjust.jitter) == (0.03, 1, "off")
    file.write_text('[adjust]\ncenter = "projective"\n')
    with pytest.raises(InputError, match=r"center stands in a file, where it is not accepted; give the flag --paper"):
        options_of_flags({}, str(file))
    assert options_of_flags({"paper": False}, None) == RunOptions()
    assert options_of_flags({}, None) == RunOptions()


def listed_in_help(verb: str, flag: str) -> dict[str, list[str]]:
    """Words of a section of the help -> the long flags in it."""
    text = CliRunner().invoke(cli, [verb, flag], prog_name="barpc").output
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.endswith(":") and not line.startswith(" "):
            found[line[:-1]] = flags = []
        elif line.startswith("  -"):
            flags += [word.strip(",") for word in line.split()[:3] if word.startswith("--")]
    return found


def test_the_help_of_a_run_has_the_usual_flags_and_says_where_the_rest_is() -> None:
    usual = [flag for flags in listed_in_help("adjust", "--help").values() for flag in flags]
    assert len(set(usual) - {"--help", "--help-all", "--output"}) == 14
    assert {"--help", "--help-all", "--out-dir", "--output", "--gcp", "--dem", "--keep-going"} <= set(usual)
    assert "--jitter" not in usual
    whole = [flag for flags in listed_in_help("adjust", "--help-all").values() for flag in flags]
    known = {flag for one in adjust.params for flag in one.opts if flag.startswith("--")}
    assert set(whole) == known | {"--help"}


def test_the_whole_help_of_a_run_has_its_flags_under_what_they_are_about() -> None:
    found = {words: set(flags) for words, flags in listed_in_help("adjust", "--help-all").items()}
    assert list(found) == ["Files and the run", "Tie points", "Cameras", "Ground"]
    assert {"--out-dir", "--overwrite", "--jobs", "--help"} <= found["Files and the run"]
    assert {"--matcher", "--aoi"} <= found["Tie points"]
    assert {"--model", "--fixed"} <= found["Cameras"]
    assert {"--gcp", "--dem", "--geoid"} <= found["Ground"]
    assert "Tie points:" not in CliRunner().invoke(cli, ["info", "--help"]).output
