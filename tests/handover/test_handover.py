"""Other programs on a run's output: each is run where its command is on PATH, on the images of the repository."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

from barpc import adjust

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "benchmarks/handover.py"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::PendingDeprecationWarning", "ignore:Dataset has no geotransform"),
]

spec = importlib.util.spec_from_file_location("handover", SCRIPT)
assert spec is not None
assert spec.loader is not None
handover = importlib.util.module_from_spec(spec)
spec.loader.exec_module(handover)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("handover") / "run"
    adjust(sorted(ROOT.glob("data_samples/view_*.tif")), folder)
    return folder


def measured(tool: str, run: Path, place: Path) -> dict[str, list[str]]:
    command = handover.COMMANDS[tool]
    if shutil.which(command) is None:
        pytest.skip(f"no {command} on PATH")
    return handover.TOOLS[tool](run, place)


def numbers(text: str) -> list[float]:
    return [float(part.split()[0]) for part in text.split(" / ")]


@pytest.mark.parametrize("tool", ["gdal", "orthority", "otb"])
def test_orthoimages_of_a_pair_agree_across_the_base(tool, finished, tmp_path):
    before, after = measured(tool, finished, tmp_path)["across the base [px]"]
    assert abs(numbers(before)[0]) > 1.0
    assert abs(numbers(after)[0]) < 0.1
    assert int(after.split("(")[1].rstrip(")")) > 50


def test_s2p_asks_for_no_correction_and_its_pairs_agree_in_height(finished, tmp_path):
    found = measured("s2p", finished, tmp_path)
    before, after = map(numbers, found["wanted pointing correction [px]"])
    assert len(before) == len(after) == 2
    assert max(before) > 1.0
    assert max(after) < 0.1
    heights = found["pairs apart in height [m], pointing correction off"]
    assert abs(numbers(heights[1])[0]) < 0.2
