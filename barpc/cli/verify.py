"""`barpc verify`: whether a finished run is still what it was."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import click

from barpc.cli.terminal import echo, tell_gate, wants_json


@click.command("verify")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("places", nargs=-1, metavar="[FOLDER...]")
def verify(run_dir: str, places: tuple[str, ...]) -> int:
    r"""Say which inputs and outputs of a finished run are still the same, and whether its cameras read as certified.

    Files are compared by the SHA-256 in summary.json. An input that is no longer where it was is looked for by its name
    beside the run, in it, and in the folders given. Exit code 0: all is as it was; 3: something is not.

    \b
    Examples:
      barpc verify adjusted
      barpc verify adjusted /archive/images
    """
    from barpc.pipeline.proof import GOOD, SAME, prove

    found = prove(Path(run_dir), [Path(place) for place in places])
    wrong = [one for one in found if one.now not in GOOD]
    if wants_json():
        echo(json.dumps([asdict(one) for one in found]))
    else:
        for one in found:
            if one.now != SAME:
                echo(f"{one.kind} {one.file}: {one.now}" + (f", {one.note}" if one.note else ""))
        counts = Counter((one.kind, one.now) for one in found)
        for kind in ("input", "output", "camera"):
            told = ", ".join(f"{count} {now}" for (of, now), count in counts.items() if of == kind)
            echo(f"{kind}s: {told or 'none'}")
    if not wrong:
        return 0
    return tell_gate("the run is not what it was:", [f"{one.file} {one.now}" for one in wrong])
