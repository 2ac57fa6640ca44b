"""What the page on clusters prints is what the schedulers' own tools accept."""

from __future__ import annotations

import re
import subprocess
from typing import Any

import pytest
from click.testing import CliRunner

from barpc.cli.main import cli
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


def parses(words: list[str]) -> None:
    """A command line whose image list does not exist gets as far as reading it."""
    found = CliRunner().invoke(cli, words)
    assert "no such file; a list of images is needed" in str(found.exception), found.output


def test_the_job_script_of_dask_jobqueue_asks_for_what_the_page_says():
    jobqueue = pytest.importorskip("dask_jobqueue")
    call = re.search(r"SLURMCluster\((.*?)\)\n", block("jobqueue"), re.DOTALL)
    assert call is not None
    with eval(f"make({call[1]})", {"make": jobqueue.SLURMCluster}) as cluster:
        script = cluster.job_script()
    for wanted in (
        "-n 1\n",
        "--cpus-per-task=1\n",
        "--mem=2G\n",
        "-t 04:00:00\n",
        "OMP_NUM_THREADS=1",
        "--nthreads 1",
    ):
        assert wanted in script, script
    compile(block("jobqueue"), "page", "exec")


def documents() -> list[dict[str, Any]]:
    yaml = pytest.importorskip("yaml")
    return list(yaml.safe_load_all(block("yaml")))


def test_the_manifest_is_of_kubernetes_schemas():
    validator = pytest.importorskip("kubernetes_validate")
    for document in documents():
        validator.validate(document, "1.30", strict=True)
    with pytest.raises(validator.ValidationError):  # it does look
        validator.validate({**documents()[0], "spec": {"ports": "8786"}}, "1.30", strict=True)


def test_the_parts_of_the_manifest_find_each_other():
    found = {(d["kind"], d["metadata"]["name"]): d["spec"] for d in documents()}
    service = found["Service", "barpc-scheduler"]
    pods = {name: spec["template"] for (kind, name), spec in found.items() if kind != "Service"}
    assert service["selector"] == pods["barpc-scheduler"]["metadata"]["labels"]
    assert {port["port"] for port in service["ports"]} == {8786}
    commands = {name: pod["spec"]["containers"][0]["command"] for name, pod in pods.items()}
    assert commands["barpc-worker"][2] == "tcp://barpc-scheduler:8786"
    assert len({pod["spec"]["containers"][0]["image"] for pod in pods.values()}) == 1
    for name, pod in pods.items():
        mounted = {mount["name"] for mount in pod["spec"]["containers"][0].get("volumeMounts", [])}
        assert mounted == {volume["name"] for volume in pod["spec"].get("volumes", [])}, name
    parses([word.replace("/run/barpc/urls.txt", "none.txt") for word in commands["barpc"][1:]])


@pytest.mark.parametrize("command", ["scheduler", "worker"])
def test_the_programs_of_the_manifest_know_their_flags(command):
    module = pytest.importorskip(f"distributed.cli.dask_{command}")
    known = {
        option for parameter in module.main.params for option in (*parameter.opts, *parameter.secondary_opts)
    }
    text = block("slurm") + " ".join(
        word for d in documents() if command in d["metadata"]["name"] and d["kind"] == "Deployment"
        for word in d["spec"]["template"]["spec"]["containers"][0]["command"]
    )  # fmt: skip
    lines = [line for line in text.splitlines() if f"dask_{command}" in line or f"dask {command}" in line]
    used = set(re.findall(r"(?<= )--[a-z-]+", " ".join(lines))) - {"--exact"}
    assert len(used) >= 2
    assert used <= known
