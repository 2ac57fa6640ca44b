"""`barpc compare`: two runs side by side."""

from __future__ import annotations

import json

import click

from barpc.cli.terminal import echo


@click.command("compare")
@click.argument("run_a", metavar="RUN_A")
@click.argument("run_b", metavar="RUN_B")
@click.option("--json", "as_json", is_flag=True, help="Print the comparison as JSON on stdout.")
def command(run_a: str, run_b: str, as_json: bool) -> int:
    r"""Compare two finished runs of the same images: errors, cameras, options.

    \b
    Examples:
      barpc compare adjusted adjusted_with_drift
      barpc compare --json monday tuesday
    """
    from barpc.report.compare import compare_runs

    comparison = compare_runs(run_a, run_b)
    if as_json:
        echo(json.dumps(comparison, indent=1))
    else:
        from barpc.cli.tables import print_comparison

        print_comparison(comparison)
    return 0
