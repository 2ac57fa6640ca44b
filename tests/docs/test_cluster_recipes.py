"""What the page on clusters prints is what the schedulers' own tools accept."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

import barpc
from barpc.base.options import RunOptions, TieOptions
from barpc.cli import cli
from tests.docs.pages import DOCS

PAGE = (DOCS / "recipes/cluster.md").read_text(encoding="utf-8")


def block(kind: str) -> str:
    found = re.search(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_job_script_is_a_script_and_its_commands_parse(tmp_path):
    script = tmp_path / "job.sh"
    script.write_text(block("slurm"))
    subprocess.run(["bash", "-n", script], check=True)
    line = re.search(r"barpc (adjust .*)", block("slurm"))
    assert line is not None
    parses(line[1].replace('"$address"', "tcp://127.0.0.1:8786").replace("images.txt", "none.txt").split())


def here(tmp_path: Path, run: str) -> str:
    """The job script on folders of this test, and on the loopback interface."""
    script = block("slurm").replace("/shared/adjusted", f"{tmp_path}/{run} --images none --options {tmp_path}/o.toml")
    for program in ("scheduler", "worker"):
        script = script.replace(f"dask_{program}", f"dask_{program} --interface lo")
    return script.replace("/shared", str(tmp_path)).replace("images.txt", f"{tmp_path}/images.txt")


def sbatch(script: str, tmp_path: Path, *words: str) -> int:
    if shutil.which("sbatch") is None:
        pytest.skip("SLURM is not installed (sbatch)")
    if " UP" not in subprocess.run(["scontrol", "ping"], capture_output=True, text=True, timeout=60).stdout:
        pytest.skip("no SLURM controller answers (scontrol ping)")
    (tmp_path / "job.sh").write_text(script)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    call = ["sbatch", "--wait", "-n", "3", "-t", "10", "-o", tmp_path / "job.log", *words, tmp_path / "job.sh"]
    return subprocess.run(call, env=environment, cwd=tmp_path, timeout=540).returncode


@pytest.mark.slow
def test_slurm_runs_the_job_script_and_gives_the_same_bytes(tmp_path):
    images = sorted((DOCS.parent / "data_samples").glob("*.tif"))[:2]
    (tmp_path / "images.txt").write_text("".join(f"{image}\n" for image in images))
    (tmp_path / "o.toml").write_text("[tie]\npoints_per_image = 600\n")
    assert sbatch(here(tmp_path, "run"), tmp_path) == 0, (tmp_path / "job.log").read_text()
    barpc.adjust(images, tmp_path / "alone", RunOptions(images="none", tie=TieOptions(points_per_image=600)))
    for name in ("tables/observations.csv", "tables/block.npz", "view_01_RPC.TXT"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


@pytest.mark.slow
def test_a_job_whose_scheduler_does_not_start_ends(tmp_path):
    script = here(tmp_path, "run").replace("distributed.cli", "distributed.none")
    assert sbatch(script, tmp_path) == 1


def parses(words: list[str]) -> None:
    """A command line whose image list does not exist gets as far as reading it."""
    found = CliRunner().invoke(cli, words)
    assert "no such file; a list of images is needed" in str(found.exception), found.output


@pytest.mark.slow
def test_the_job_script_of_dask_jobqueue_asks_for_what_the_page_says():
    jobqueue = pytest.importorskip("dask_jobqueue")
    call = re.search(r"SLURMCluster\((.*?)\)\n", block("jobqueue"), re.DOTALL)
    assert call is not None
    with eval(f"make({call[1]})", {"make": jobqueue.SLURMCluster}) as cluster:
        script = cluster.job_script()
    for wanted in ("-n 1\n", "--cpus-per-task=1\n", "--mem=2G\n", "-t 04:00:00\n", "OMP_NUM_THREADS=1", "--nthreads 1"):
        assert wanted in script, script
    compile(block("jobqueue"), "page", "exec")


@pytest.mark.parametrize("command", ["scheduler", "worker"])
def test_the_programs_of_the_job_script_know_their_flags(command):
    module = pytest.importorskip(f"distributed.cli.dask_{command}")
    known = {option for parameter in module.main.params for option in (*parameter.opts, *parameter.secondary_opts)}
    lines = [line for line in block("slurm").splitlines() if f"dask_{command}" in line]
    used = set(re.findall(r"(?<= )--[a-z-]+", " ".join(lines))) - {"--exact"}
    assert len(used) >= 2
    assert used <= known
