"""`barpc report`: report.html made again."""

from __future__ import annotations

import click

from barpc.cli.terminal import echo


@click.command("report")
@click.argument("run_dir", metavar="RUN_DIR")
def command(run_dir: str) -> int:
    r"""Make report.html of a finished run again, from its summary.json and tables.

    \b
    Example:
      barpc report adjusted
    """
    from barpc.report.page import remake_report

    echo(remake_report(run_dir))
    return 0
