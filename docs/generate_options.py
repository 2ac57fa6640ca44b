"""Write docs/options.md, docs/man/barpc.1 and barpc/base/keywords.py from the declared options and the verbs' flags.

python docs/generate_options.py            # writes all
python docs/generate_options.py --print    # prints the page of options
"""

from __future__ import annotations

import argparse
import inspect
import re
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import click

from barpc.base import verb_options
from barpc.base.declarations import Declared, Options, Rule, declared
from barpc.base.options import AdjustOptions, FitOptions, RunOptions, TieOptions
from barpc.cli import COMMANDS, cli
from barpc.cli.flags import ADJUSTMENT, REMOTE, RUN, TIE, field_of, flag_name
from barpc.verbs.options import FLAG_NAMES

PAGE = Path(__file__).with_name("options.md")
MANUAL = Path(__file__).parent / "man" / "barpc.1"
KEYWORDS = Path(verb_options.__file__).with_name("keywords.py")
TABLES = {"": RunOptions, "tie": TieOptions, "adjust": AdjustOptions, "fit": FitOptions}
"""Table of an options file -> the record it fills; "" is the file's top level."""

HEAD = """# Options

<!-- Written by docs/generate_options.py from barpc/base/options.py, verb_options.py and the verbs. -->

Every option has a default; a file given with `--options` wins over it, and a flag over both. An unknown name, a wrong
type or a value out of range is refused before anything is computed. In brackets: what it may hold, and the default.

```toml
# run.toml: barpc adjust scene/*.tif --options run.toml -o adjusted
rpc_formats = ["txt", "geom"]

[tie]
points_per_image = 8000
```

From Python the same, as keywords of `barpc.adjust` or with the records named in the headings:

```python
import barpc

barpc.RunOptions(adjust=barpc.AdjustOptions(sigma_attitude=3.0))
```
"""


def default(value: Any) -> str:
    """A default as an options file would spell it."""
    if value is None or value == {}:
        return "-"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return "`[" + ", ".join(f'"{v}"' if isinstance(v, str) else str(v) for v in value) + "]`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


def short(kind: Any, rule: Rule) -> str:
    """Return what an option may hold in as few words as tell it."""
    of, bounds = get_args(kind), rule.bounds().strip()
    if get_origin(kind) is tuple:
        return f"{'list' if of[-1] is ... else len(of)} of {short(of[0], rule)}"
    if choices := rule.choices(kind):
        return ", ".join(map(str, choices)) + (", module:name" if rule.hook else "")
    if kind is bool:
        return ""
    if kind is int:
        return f"integer {bounds}".strip()
    return (bounds or "number") if kind is float else rule.unit or "text"


def option_list(name: str, record: type[Options], flags: dict[str, str]) -> list[str]:
    """Return the options of one table of the file, a line each, with the flags that set them."""
    lines = ["", f"### {f'[{name}]' if name else 'Top level'}: `{record.__name__}`", ""]
    for field, one in declared(record).items():
        if field in TABLES:
            continue
        flag = flags.get(f"{name}.{field}" if name else field, "")
        held = "; ".join(word for word in (short(one.kind, one.rule), default(one.default)) if word)
        lines.append(f"- `{field}`{flag and f', `{flag}`'} ({held}): {one.rule.help}")
    return lines


def parts(command: click.Command, name: str) -> tuple[str, str, str, list[tuple[str, str]]]:
    """Return a command in four parts: its usage, its first words, its examples, its flags with their help."""
    context = click.Context(command, info_name=name, **{**cli.context_settings, "terminal_width": 100})
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    first, *examples = command.help.replace("\b", "\\b").split("\\b")
    text = inspect.cleandoc("\n".join(examples[0].strip("\n").splitlines()[1:])).strip() if examples else ""
    records = [p.get_help_record(context) for p in command.params if isinstance(p, click.Option)]
    return usage, " ".join(first.split()), text, [record for record in records if record is not None]


def verb_section(name: str, known: dict[str, str]) -> list[str]:
    """Return a verb: its usage, its first words, its examples, and the flags that are not known yet."""
    usage, first, examples, flags = parts(
        cli.get_command(click.Context(cli, **cli.context_settings), name), f"barpc {name}"
    )
    lines = ["", f"### {usage.replace(' [OPTIONS]', '')}".replace("[", r"\["), "", first]
    if examples:
        lines += ["", "```", *(line.strip() for line in examples.splitlines() if line.strip()), "```"]
    new, old = [], []
    for names, text in flags:
        flag, words = names.split(", ")[-1].split()[0], help_text(text)
        if known.setdefault(flag, words) is words or not words.startswith(known[flag]):
            new.append(f"- `{names}`: {words}")
        else:
            old.append(f"`{flag}`")
    lines += ["", *new] if new else []
    return lines + (["", f"As above: {', '.join(old)}."] if old else [])


def help_text(text: str) -> str:
    """A flag's help as Markdown, in which `[a] [b]` would be a link."""
    return re.sub(r"\s+", " ", text).replace("] [", r"] \[")


def page() -> str:
    """Return the whole page."""
    flags = {target: flag_name(target) for target in (*TIE, *ADJUSTMENT, *RUN, REMOTE)}
    lines = [HEAD, "## Options of a run"]
    for name, record in TABLES.items():
        lines += option_list(name, record, flags)
    lines += ["", "## Verbs", ""]
    lines += ["Before or behind every verb: `--json` (results as JSON), `-q`, `-v`, `-vv`, `--debug`."]
    known = {flag: help_text(field_of(target).rule.help) for target, flag in flags.items()}
    for name in COMMANDS:
        lines += verb_section(name, known)
    return "\n".join(lines) + "\n"


KEYWORD_HEAD = '''"""The keywords of the verbs, for type checkers. Written by docs/generate_options.py: edit the records of options."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

from barpc.base.options import AdjustOptions, FitOptions, TieOptions

PathLike = str | os.PathLike[str]
Files = PathLike | Sequence[PathLike]
'''


def keyword_type(one: Declared) -> str:
    """Return what a keyword takes, as a type checker reads it."""
    kind, of_path = one.kind, one.rule.unit in ("file", "dir")
    if isinstance(one.default, Options):
        return f"{kind.__name__} | Mapping[str, Any]"
    if get_origin(kind) is Literal:
        found = str(kind).removeprefix("typing.").replace("'", '"')
    elif get_origin(kind) is tuple:
        found = "Files" if of_path else f"Sequence[{get_args(kind)[0].__name__}]"
    else:
        found = "PathLike" if of_path else kind.__name__
    return f"{found} | None" if one.optional else found


def keywords() -> str:
    """Return the module of the keywords: a TypedDict a verb, or what several verbs share."""
    run = {
        name: one
        for record in (TieOptions, AdjustOptions, FitOptions, RunOptions)
        for name, one in declared(record).items()
    }
    verbs: dict[str, dict[str, Declared]] = {"Run": run | {flag: run[name] for name, flag in FLAG_NAMES.items()}}
    for name, record in vars(verb_options).items():
        if getattr(record, "__module__", "") == verb_options.__name__ and record is not verb_options.HeightOptions:
            more = declared(FitOptions) if record is verb_options.RefitOptions else {}
            verbs[name.removesuffix("Options")] = {**more, **declared(record)}
    parts = [KEYWORD_HEAD]
    for name, known in verbs.items():
        lines = [f"    {field}: {keyword_type(one)}" for field, one in known.items()]
        words = "every run" if name == "Run" else f"`{name}Options`"
        parts += [
            "\n".join(
                [
                    f"\n\nclass {name}Keywords(TypedDict, total=False):",
                    f'    """Keywords of {words}."""',
                    "",
                    *lines,
                    "",
                ]
            )
        ]
    return "".join(parts)


def roff(text: str) -> str:
    """Plain text as a line of a manual page: a dash is one to be typed, a dot in front is no macro."""
    text = re.sub(r"\s+", " ", text).replace("\\", "\\e").replace("-", "\\-")
    return "\\&" + text if text.startswith((".", "'")) else text


def man_section(command: click.Command, name: str) -> list[str]:
    """A command of the manual page: its words, flags and examples."""
    usage, first, examples, flags = parts(command, name)
    lines = [".nf", roff(usage), ".fi", ".PP", roff(first)]
    for names, text in flags:
        lines += [".TP", f".B {roff(names)}", roff(text)]
    if examples:
        lines += [".PP", ".nf", *map(roff, examples.splitlines()), ".fi"]
    return lines


def manual() -> str:
    """The manual page, with the man macros of roff."""
    lines = ['.TH BARPC 1 "" barpc "User Commands"', ".SH NAME"]
    lines += [roff("barpc - bundle adjustment of satellite images with RPC cameras"), ".SH SYNOPSIS"]
    lines += man_section(cli, "barpc")
    for name, told in COMMANDS.items():
        lines += [f".SH BARPC {name.upper()}", roff(told), ".PP"]
        lines += man_section(cli.get_command(click.Context(cli, **cli.context_settings), name), f"barpc {name}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write or print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--print", action="store_true", dest="show", help="print instead of writing")
    if parser.parse_args().show:
        print(page(), end="")
    else:
        PAGE.write_text(page(), encoding="utf-8")
        MANUAL.write_text(manual(), encoding="utf-8")
        KEYWORDS.write_text(keywords(), encoding="utf-8")


if __name__ == "__main__":
    main()
