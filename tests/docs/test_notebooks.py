"""The notebooks run from the first cell to the last, and show what their words say."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_output_is_kept_in_the_repository(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")] == []
    assert cells[0]["cell_type"] == "markdown"


def printed(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """What a notebook prints that is run in a folder beside data_samples/."""
    client, formats = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    shutil.copytree(ROOT / "data_samples", tmp_path / "data_samples")
    (tmp_path / "notebooks").mkdir()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    notebook = formats.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    where = {"metadata": {"path": str(tmp_path / "notebooks")}}
    client.NotebookClient(notebook, timeout=None, kernel_name="python3", resources=where).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    return "".join(output.get("text") or output["data"]["text/plain"] + "\n" for output in outputs)


def numbers(line: str, text: str) -> list[float]:
    """The numbers of the line that begins so."""
    (rest,) = re.findall(rf"^{re.escape(line)}(.*)$", text, re.MULTILINE)
    return [float(number) for number in re.findall(r"[-+]?\d+\.\d+", rest)]


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
def test_the_first_run(tmp_path, monkeypatch):
    said = printed("first_run", tmp_path, monkeypatch)
    assert "AdjustResult(adjust: 3 views, " in said
    (mean, scatter), (mean_after, scatter_after) = (numbers(n, said) for n in ("as delivered", "adjusted"))
    assert abs(mean_after - mean) < 2.0
    assert -92 < mean < -88
    assert 6 < scatter < 8
    assert scatter_after < 0.02
    assert (tmp_path / "notebooks" / "first_run" / "report.html").is_file()


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
def test_two_dates_with_control(tmp_path, monkeypatch):
    said = printed("dates_with_control", tmp_path, monkeypatch)
    names = "as delivered", "each date by itself", "all together", "together, five GCPs"
    (before, _), (alone, _), (together, above), (held, in_place) = (numbers(name, said) for name in names)
    assert min(before, alone) > 50
    assert max(abs(together), abs(held)) < 0.05
    assert abs(above) > 10
    assert abs(in_place) < 0.1
