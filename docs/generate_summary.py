"""Write docs/summary.md from the records that summary.json is made of.

python docs/generate_summary.py            # writes it
python docs/generate_summary.py --print    # prints it
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from barpc.report.records import Record
from barpc.report.summary import Summary

PAGE = Path(__file__).with_name("summary.md")
HEAD = """# The values of summary.json

<!-- Written by docs/generate_summary.py. Edit the records in barpc/report/summary/, then run it again. -->

Pixel (0, 0) is the centre of the first one. A number that is not finite is null. An *optional* value may be missing.
The same as a [JSON schema](summary.schema.json).
"""


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


def in_words(part: Mapping[str, Any]) -> str:
    """A type."""
    if "enum" in part:
        return ", ".join(f"`{value}`" for value in part["enum"])
    kinds = part["type"] if isinstance(part["type"], list) else [part["type"]]
    return " or ".join(
        f"array of {part['minItems']}" if k == "array" and "maxItems" in part else k for k in kinds
    )


def page() -> str:
    """The whole page."""
    lines = [HEAD]
    for name, record in parts_of(Summary):
        schema = record.json_schema()
        lines += [f"## `{name}`" if name else "## The file", "", record.__doc__ or "", ""]
        lines += ["| value | type | meaning |", "|---|---|---|"]
        for key, part in schema["properties"].items():
            optional = "" if key in schema["required"] else " *optional*"
            lines.append(f"| `{key}`{optional} | {in_words(part)} | {part['description']} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Write or print the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--print", action="store_true", dest="show", help="print instead of writing")
    if parser.parse_args().show:
        print(page(), end="")
    else:
        PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
