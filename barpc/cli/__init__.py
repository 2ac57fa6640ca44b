"""The `barpc` command: a table of verbs, exit codes, and the options that all verbs share.

The command line parses, calls, prints: no mathematics, no file formats. The click command of a verb has its name, in a
module that is loaded only when it is used: `barpc --help` imports click and nothing else of weight.
"""

from __future__ import annotations

import difflib
import gc
import logging
import os
import sys
import traceback
import warnings
from importlib import import_module
from typing import Any

import click

from barpc import __version__
from barpc.base.errors import BarpcError, BarpcWarning, Remark, UsageError, has_room, out_of_memory
from barpc.cli.process import EXIT_INTERRUPTED, INTERRUPTED, Kept, hold_streams, interruptible
from barpc.cli.terminal import EXIT_GATE as EXIT_GATE
from barpc.cli.terminal import Formatter, echo, remark, say
from barpc.verbs.workers import THREADS, quicken

_LIBRARIES = 512 << 20  # bytes that numpy, scipy, GDAL and OpenCV map: 460 MB, of which OpenBLAS waits for its own

EXIT_FAILED, EXIT_USAGE = 1, 2

_NO_ARGUMENTS: Any = getattr(click.exceptions, "NoArgsIsHelpError", click.exceptions.Exit)  # not in click 8.1


COMMANDS = {
    "adjust": "Correct the cameras of overlapping images and write fresh RPCs.",
    "match": "Match tie points and stop.",
    "check": "Measure how well cameras agree, without adjusting.",
    "fit": "Fit an RPC to any camera or to points, and certify it.",
    "info": "Sources, view angles and pair geometry of cameras.",
    "project": "Ground points to image points.",
    "localize": "Image points to ground points, at an altitude or on a DEM.",
    "triangulate": "Corresponding image points to ground points.",
    "convert": "Write RPCs in other formats, cut out windows, deliver images.",
    "export": "Export a finished run to Sat-NeRF, COLMAP, s2p, CARS, ASP or a catalogue.",
    "dsm": "A first surface model, with its uncertainty.",
    "ortho": "Orthoimages on one grid, by GDAL's warper.",
    "calibrate": "Estimate a sensor's interior distortion from finished runs.",
    "verify": "Whether inputs, outputs and cameras of a run are unchanged.",
    "report": "Make report.html of a run again, compare two, or list many.",
}
"""Verb -> its line in `barpc --help`; the code is the function `<verb>` of `barpc.cli.<verb>`, or of these:"""
_COMMAND_MODULES = {
    **dict.fromkeys(("match", "check"), "adjust"),
    **dict.fromkeys(("report", "export", "verify", "dsm", "ortho", "calibrate"), "run_commands"),
    **dict.fromkeys(("localize", "triangulate"), "project"),
}

_GENERAL = {
    **{"-q": "quiet", "--quiet": "quiet", "-v": "verbose", "--verbose": "verbose"},
    **{"--debug": "debug", "--json": "as_json"},
}


def _kept_lines(text: str | None) -> str | None:
    r"""Turn the written ``\b`` of a raw docstring into the character by which click keeps lines apart."""
    return text and text.replace("\\b\n", "\b\n")


class Verbs(click.Group):
    """A group that imports a verb's module when the verb is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the verbs, in the table's order."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the verb's module and hand out its command."""
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"barpc.cli.{_COMMAND_MODULES.get(cmd_name, cmd_name)}")
        command: click.Command = getattr(module, cmd_name)
        command.help = _kept_lines(command.help)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Refuse an unknown verb with the nearest known one."""
        args = self._general(ctx, args)
        if args and not args[0].startswith("-") and args[0] not in COMMANDS:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f" Did you mean '{near[0]}'?" if near else f" One of: {', '.join(COMMANDS)}."
            raise click.UsageError(f"No such verb '{args[0]}'.{hint}")
        return super().resolve_command(ctx, args)

    def _general(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take out of a verb's arguments those that every verb has: they may stand before and after it."""
        end = args.index("--") if "--" in args else len(args)
        for word in args[1:end]:
            name = "verbose" if word == "-vv" else _GENERAL.get(word)
            if name is not None:
                ctx.params[name] = ctx.params[name] + word.count("v", 0, 3) if name == "verbose" else True
        return [word for i, word in enumerate(args) if not 0 < i < end or word not in (*_GENERAL, "-vv")]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs from the table, without importing them."""
        with formatter.section("Verbs"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=Verbs, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, message="barpc %(version)s")
@click.option("-v", "--verbose", count=True, help="Log stages with their seconds (-vv: everything).")
@click.option(
    "-q",
    "--quiet",
    is_flag=True,
    help="Errors only, and requested numbers or JSON: no verdict, no progress, no log.",
)
@click.option("--json", "as_json", is_flag=True, help="Results as JSON on stdout.")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def cli(verbose: int, quiet: bool, **_: bool) -> None:
    r"""Correct the camera models (RPCs) of satellite images.

    \b
    Example:
      barpc adjust scene/*.tif -o adjusted

    Exit codes: 0 done without reservation; 1 an error (one line names the file and the remedy); 2 wrong usage; 3
    finished, but an image, a control point or a file needs review (the last line names it and the reason); 130
    interrupted.
    """
    if not has_room(_LIBRARIES):  # OpenBLAS tries for ever, deaf to signals
        raise MemoryError
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Formatter("%(levelname).1s %(name)s: %(message)s" if verbose else "barpc: %(message)s"))
    if not verbose:  # libraries log what is raised again, with its traceback
        handler.addFilter(logging.Filter("barpc"))
    logging.basicConfig(level=level, handlers=[handler])
    warnings.showwarning = _log_warning
    warnings.simplefilter("always", Remark)


cli.help = _kept_lines(cli.help)


def main(args: list[str] | None = None) -> None:
    """Run a verb, and turn errors into one line and an exit code."""
    argv = sys.argv[1:] if args is None else args
    if args is None:  # the process is ours
        quicken()
        hold_streams()
    os.environ.update(dict.fromkeys(THREADS, "1"))  # sums keep their order whatever is set; -j spreads the work
    code: object
    kept = Kept()
    with interruptible(own=args is None) as interrupt, warnings.catch_warnings():
        try:
            code = cli.main(args=argv, prog_name="barpc", standalone_mode=False, obj=kept)
            sys.stdout.flush()
        except click.exceptions.Exit as stop:
            code = stop.exit_code
        except _NO_ARGUMENTS as error:
            error.show()
            code = error.exit_code
        except BrokenPipeError:  # whoever read the results has gone
            code = EXIT_FAILED
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (nobody wants a traceback)
            # what an interruption makes of others' code may be any error
            code, message = _exit_message(KeyboardInterrupt() if interrupt.end() else error, kept)
            if "--debug" in argv:
                echo(traceback.format_exc(), err=True)
            say(message)
        code = code if isinstance(code, int) else 0
        interrupt.done(code)
    if args is None:
        gc.freeze()  # nor at the end in what the system takes back
    sys.exit(code)


def _exit_message(error: BaseException, kept: Kept) -> tuple[int, str]:
    """Return the exit code and the message of an error; `kept`: what an interrupted verb left."""
    if isinstance(error, click.Abort):  # of an end of file, too
        error = error.__cause__ or error
    if isinstance(error, (click.Abort, KeyboardInterrupt)):
        return EXIT_INTERRUPTED, f"{INTERRUPTED}; {kept}"
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        where = context.command_path if context is not None else "barpc"
        return error.exit_code, f"{error.format_message()} (see '{where} --help')"
    text = f"unexpected {type(error).__name__}: {error}; this is a bug: please report what --debug shows"
    if isinstance(error, BarpcError):
        text = str(error)
    elif out_of_memory(error):
        text = "out of memory; what was finished is kept: run the same command again, with a smaller -j or [tie] tile"
    elif isinstance(error, OSError) and error.strerror:
        text = f"{error.filename or 'the system'}: {error.strerror}"
    return EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED, text


def _log_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object, **__: object
) -> None:
    """Log a warning as one line: barpc's own always, those of libraries with -v; a remark is printed."""
    text = " ".join(str(message).split())
    if issubclass(category, Remark):
        remark(text)
    elif issubclass(category, BarpcWarning):
        logging.getLogger("barpc").warning(text)
    else:
        logging.getLogger("py.warnings").info("%s:%d: %s: %s", filename, lineno, category.__name__, text)
