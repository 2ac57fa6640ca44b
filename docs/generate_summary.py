"""Write docs/summary.md from the records that summary.json is made of.

python docs/generate_summary.py            # writes it
python docs/generate_summary.py --print    # prints it
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from barpc.report.records import Record
from barpc.report.summary import Summary

PAGE = Path(__file__).with_name("summary.md")
HEAD = """# The values of summary.json

<!-- Written by docs/generate_summary.py. Edit the records in barpc/report/summary/, then run it again. -->

Pixel (0, 0) is the centre of the first one. A number that is not finite is null; `?` behind a type: it may be null; no
type: a number or null; `*` behind a name: it may be missing. Records have headings of their own. Paths are
relative to the run folder. The same as a [JSON schema](summary.schema.json).
"""

WORDS = {str: "text", bool: "true/false", int: "integer", float: "number", Mapping: "record"}
"""Types of Python in the words of the page."""


def parts_of(record: type[Record], name: str = "") -> Iterator[tuple[str, type[Record]]]:
    """The record and those that its fields hold, each behind where it stands."""
    yield name, record
    hints = get_type_hints(record)
    for field in fields(record):
        kinds = [hints[field.name], *get_args(hints[field.name])]
        for kind in kinds:
            if isinstance(kind, type) and issubclass(kind, Record):
                many = "[]" if Ellipsis in kinds else ""
                yield from parts_of(kind, f"{name}.{field.name}{many}".lstrip("."))


def in_words(kind: Any) -> str:
    """Return a type in as few characters as tell it; `?`: or null."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "/".join(f"`{value}`" for value in parts if value is not None)
    if origin in (Union, UnionType):
        return " or ".join(in_words(part) for part in parts if part is not NoneType) + "?" * (NoneType in parts)
    if origin is tuple:
        return "list" if parts[-1] is ... else f"{len(parts)} values"
    return "record" if isinstance(kind, type) and issubclass(kind, Record) else WORDS[origin or kind]


def page() -> str:
    """Return the whole page: a heading for each record, however many places hold one, and a line for each field."""
    places: dict[type[Record], list[str]] = {}
    for name, record in parts_of(Summary):
        places.setdefault(record, []).append(name)
    lines = [HEAD]
    for record, names in places.items():
        lines += ["## " + (", ".join(f"`{name}`" for name in names if name) or "The file"), ""]
        lines += [record.__doc__ or "", ""]
        hints = get_type_hints(record)
        for one in fields(record):
            star = "" if one.default is MISSING else r"\*"
            kind = "" if (words := in_words(one.metadata["kind"] or hints[one.name])) == "number?" else f" ({words})"
            lines.append(f"- `{one.name}`{star}{kind}: {one.metadata['meta'].description}")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Write or print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--print", action="store_true", dest="show", help="print instead of writing")
    if parser.parse_args().show:
        print(page(), end="")
    else:
        PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
