"""`barpc report`: report.html made again, or two runs side by side."""

from __future__ import annotations

import json

import click

from barpc.cli.terminal import echo


@click.command("report")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("other", required=False, metavar="[OTHER_RUN]")
@click.option("--json", "as_json", is_flag=True, help="Print the comparison of two runs as JSON on stdout.")
def report(run_dir: str, other: str | None, as_json: bool) -> int:
    r"""Make report.html of a finished run again, from its summary.json and tables; or compare two runs.

    Two finished runs of the same images are compared on the terminal: errors, cameras, options.

    \b
    Examples:
      barpc report adjusted
      barpc report adjusted adjusted_with_drift
      barpc report --json monday tuesday
    """
    if other is None:
        if as_json:
            raise click.UsageError("--json goes with two runs; the summary.json of one is there already")
        from barpc.report.page import remake_report

        echo(remake_report(run_dir))
        return 0
    from barpc.cli.tables import print_comparison
    from barpc.report.compare import compare_runs

    comparison = compare_runs(run_dir, other)
    if as_json:
        echo(json.dumps(comparison, indent=1))
    else:
        print_comparison(comparison)
    return 0
