"""What the command makes of words, errors and signals before and after a verb does its work."""

from __future__ import annotations

import gc
import logging
import os
import sys
import warnings
from collections.abc import Callable
from types import SimpleNamespace

import click
import pytest

from barpc.base.errors import BarpcWarning, InputError
from barpc.cli import COMMANDS, cli, main
from barpc.cli.process import interruptible
from barpc.verbs.workers import THREADS


def run(*args: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as stop:
        main([str(arg) for arg in args])
    assert isinstance(stop.value.code, int)
    return stop.value.code


def resolved(*words: str) -> tuple[list[str], dict[str, object]]:
    """What is left of a command line before its verb is called, and the flags that every verb has."""
    context = click.Context(cli, **cli.context_settings)
    context.params = {"verbose": 0, "quiet": False, "debug": False}
    name, command, rest = cli.resolve_command(context, list(words))
    assert command is not None
    return [str(name), *rest], context.params


# --- words ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["projct"], "No such verb 'projct'. Did you mean 'project'?"),
        (["xyz"], f"No such verb 'xyz'. One of: {', '.join(COMMANDS)}."),
    ],
)  # fmt: skip
def test_a_word_that_is_not_known_is_met_with_the_one_that_is(words: list[str], told: str) -> None:
    with pytest.raises(click.UsageError) as error:
        resolved(*words)
    assert error.value.message == told


@pytest.mark.parametrize(
    "words",
    [
        ["info", "--loss"],  # its verb takes no options file
        ["adjust", "--nothing"],
        ["adjust", "--overwrite"],
        ["info", "--", "--size"],  # the name of a file
        ["fit", "size"],
        ["--nothing"],
        ["-v", "info"],  # before a verb they are the group's own
    ],
)
def test_other_words_are_left_to_click(words: list[str]) -> None:
    if words[0].startswith("-"):
        with pytest.raises(click.UsageError, match="No such"):
            resolved(*words)
    else:
        assert resolved(*words)[0] == words


@pytest.mark.parametrize(
    ("words", "rest", "params"),
    [
        ("info a -v", "info a", (1, False, False)),
        ("info -vv a --verbose", "info a", (3, False, False)),
        ("info -q a", "info a", (0, True, False)),
        ("info --quiet --debug", "info", (0, True, True)),
        ("info a -- -v -q", "info a -- -v -q", (0, False, False)),
        ("info -v -- --debug", "info -- --debug", (1, False, False)),
        ("info -vvv", "info -vvv", (0, False, False)),
    ],
)
def test_flags_of_every_verb_are_taken_out_of_its_words(words: str, rest: str, params: tuple[int, bool, bool]) -> None:
    others, flags = resolved(*words.split())
    assert others == rest.split()
    assert (flags["verbose"], flags["quiet"], flags["debug"]) == params


def test_there_is_no_verb_beside_the_table() -> None:
    context = click.Context(cli, **cli.context_settings)
    assert cli.get_command(context, "nothing") is None
    assert cli.list_commands(context) == list(COMMANDS)
    for name in ("match", "report", "localize", "export"):
        command = cli.get_command(context, name)
        assert command is not None
        assert command.name == name
        assert "\b\n" in str(command.help)
        assert "\\b" not in str(command.help)


def test_help_lists_the_verbs_and_a_wrong_word_ends_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    told = capsys.readouterr().out
    lines = [line.split(maxsplit=1) for line in told.splitlines()]
    assert all([name, text] in lines for name, text in COMMANDS.items() if len(text) < 70)
    assert "Verbs:" in told
    assert "\\b" not in told
    assert max(map(len, told.splitlines())) <= 110
    assert run("-h") == 0
    assert run("--version") == 0
    assert run("info", "--nothing", "a") == 2
    said = capsys.readouterr().err
    assert said.startswith("barpc: No such option")
    assert said.endswith(" (see 'barpc info --help')\n")
    assert run() == 2


# --- errors -----------------------------------------------------------------------------------------------


def _os_error(number: int, text: str, name: str | None) -> OSError:
    error = OSError(number, text)
    error.filename = name
    return error


def _from(cause: BaseException, error: BaseException) -> BaseException:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (KeyboardInterrupt(), 130, "interrupted; nothing was kept"),
        (_from(KeyboardInterrupt(), click.Abort()), 130, "interrupted; nothing was kept"),
        (_from(EOFError("x"), click.Abort()), 1, "unexpected EOFError: x; this is a bug: please report what --debug "
         "shows"),
        (click.Abort(), 130, "interrupted; nothing was kept"),
        (click.UsageError("no"), 2, "no (see 'barpc --help')"),
        (click.UsageError("no", click.Context(click.Command("x"), info_name="x")), 2, "no (see 'x --help')"),
        (click.ClickException("no"), 1, "no (see 'barpc --help')"),
        (InputError("a.tif: no"), 1, "a.tif: no"),
        (MemoryError(), 1, "out of memory; what was finished is kept: run the same command again, with a smaller -j "
         "or [tie] tile"),
        (_os_error(28, "No space left on device", "a.tif"), 1, "a.tif: No space left on device"),
        (_os_error(5, "Input/output error", None), 1, "the system: Input/output error"),
        (OSError("odd"), 1, "unexpected OSError: odd; this is a bug: please report what --debug shows"),
        (KeyError("k"), 1, "unexpected KeyError: 'k'; this is a bug: please report what --debug shows"),
    ],
)  # fmt: skip
def test_an_error_is_an_exit_code_and_a_sentence(
    error: BaseException, code: int, text: str, verb: Callable[[object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    verb(error)
    assert run("info") == code
    assert capsys.readouterr() == ("", f"barpc: {text}\n")


@pytest.mark.parametrize(("value", "code"), [(0, 0), (3, 3), (None, 0), ("text", 0)])
def test_what_a_verb_returns_is_the_exit_code(value: object, code: int, verb: Callable[[object], None]) -> None:
    verb(value)
    assert run("info") == code


def test_an_error_is_one_line_and_debug_shows_where_it_came_from(
    verb: Callable[[object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    verb(InputError("a.tif: no"))
    assert run("info") == 1
    assert capsys.readouterr() == ("", "barpc: a.tif: no\n")
    assert run("info", "--debug") == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("Traceback")
    assert told.err.endswith("barpc: a.tif: no\n")
    verb(KeyboardInterrupt())
    assert run("info") == 130


def test_a_reader_that_has_gone_is_no_error_to_speak_of(
    verb: Callable[[object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    verb(BrokenPipeError())
    assert run("info") == 1
    assert capsys.readouterr().err == ""


def test_only_a_process_of_its_own_has_its_garbage_left_alone(
    verb: Callable[[object], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[object]()
    monkeypatch.setattr(gc, "set_threshold", asked.append)
    monkeypatch.setattr(gc, "freeze", lambda: asked.append("freeze"))
    monkeypatch.setattr(sys, "argv", ["barpc", "info", "a b"])
    monkeypatch.delenv(THREADS[0], raising=False)
    monkeypatch.setenv(THREADS[1], "4")
    monkeypatch.setenv(THREADS[2], "4")
    verb(0)
    assert run("info") == 0
    assert asked == []
    assert [os.environ[name] for name in THREADS] == ["1", "1", "1"]
    given = list[object]()
    monkeypatch.setattr(cli, "main", lambda **how: given.append(how))
    monkeypatch.setattr("barpc.cli.interruptible", lambda own: asked.append(own) or interruptible(own=False))
    monkeypatch.setattr("barpc.cli.hold_streams", lambda: asked.append("streams"))
    with pytest.raises(SystemExit):
        main()
    assert asked == [50_000, "streams", True, "freeze"]
    (one,) = given
    assert (one.pop("obj").folder, one) == (
        None,
        {"args": ["info", "a b"], "prog_name": "barpc", "standalone_mode": False},
    )


# --- the log ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "level", "all_of_it"),
    [((), logging.WARNING, False), (("-q",), logging.ERROR, False), (("-v",), logging.INFO, True),
     (("-vv",), logging.DEBUG, True), (("-v", "-v", "-v"), logging.DEBUG, True), (("-q", "-v"), logging.ERROR, True)],
)  # fmt: skip
def test_how_much_is_logged(
    words: tuple[str, ...],
    level: int,
    all_of_it: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A warning of barpc is told always, one of a library with -v."""
    given = list[dict[str, object]]()
    seen = list[object]()
    caplog.set_level(logging.INFO)
    before = warnings.showwarning

    @click.command()
    @click.pass_context
    def probe(context: click.Context) -> int:
        asked = context.find_root().params
        seen.append({name: asked[name] for name in ("quiet", "verbose")})
        warnings.simplefilter("always")
        warnings.warn_explicit("one\n two", BarpcWarning, "f.py", 3)
        warnings.warn_explicit("old\n thing", DeprecationWarning, "f.py", 3)
        return 0

    monkeypatch.setattr(logging, "basicConfig", lambda **how: given.append(how))
    monkeypatch.setitem(sys.modules, "barpc.cli.info", SimpleNamespace(info=probe))
    assert run(*words, "info") == 0
    verbose = sum(word.count("v") for word in words)
    assert seen == [{"quiet": "-q" in words, "verbose": verbose}]
    assert caplog.record_tuples == [
        ("barpc", logging.WARNING, "one two"),
        ("py.warnings", logging.INFO, "f.py:3: DeprecationWarning: old thing"),
    ]
    (how,) = given
    assert how["level"] == level
    (handler,) = how["handlers"]  # type: ignore[misc]
    assert handler.stream is sys.stderr
    for name, shown in (("barpc.a", True), ("gcsfs", all_of_it)):
        assert bool(handler.filter(logging.LogRecord(name, 40, "", 0, "x", (), None))) == shown
    assert warnings.showwarning is before
