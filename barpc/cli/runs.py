"""What `adjust`, `match` and `check` have in common: options, workers, progress, and how a result is shown."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from barpc.cli.options import image_paths, run_options
from barpc.cli.progress import executor_for, progress_bars
from barpc.cli.terminal import echo, tell_gate

if TYPE_CHECKING:
    from barpc.pipeline import AdjustResult


def run(
    obj: Mapping[str, Any],
    work: Callable[..., AdjustResult],
    images: tuple[str, ...],
    flags: dict[str, Any],
    **fixed: Any,
) -> int:
    """Run one of the pipeline's entries with what the command line says, show the result, give the exit code.

    Parameters
    ----------
    obj : mapping
        What all verbs share: "quiet".
    work : callable
        `work(paths, options, executor=..., progress=...)`.
    images : tuple of str
        As typed.
    flags : dict
        Every other parameter of the verb.
    **fixed
        Options that the verb sets itself.
    """
    paths = image_paths(images, flags.pop("image_list"))
    jobs, as_json = flags.pop("jobs"), flags.pop("as_json")
    options = replace(run_options(flags, flags.pop("options_file")), **fixed)
    with executor_for(jobs) as executor, progress_bars(obj["quiet"]) as progress:
        result = work(paths, options, executor=executor, progress=progress)
    if as_json:
        echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        from barpc.cli.tables import print_summary

        print_summary(result.summary)
    return 0 if result.passed else tell_gate(result.summary["headline"], result.summary["reasons"])
