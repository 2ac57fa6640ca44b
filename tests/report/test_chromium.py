"""The report in a real browser: no errors, no overflow, no text over text, tables that sort.

A page of its own holds the report in a frame of a given width and writes what it finds into its body; headless
Chromium prints that body.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

import pytest

from .conftest import Finished

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--allow-file-access-from-files",
    "--virtual-time-budget=8000",
    "--dump-dom",
]

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine (apt-get install chromium)")
pytest.importorskip("jinja2")


def probe(html: str, width: int, folder: Path, dark: bool = False, *, by: str = "probe.js") -> dict[str, Any]:
    """What a script finds in the browser on a page shown `width` pixels wide."""
    script = Path(__file__).with_name(by).read_text(encoding="utf-8")
    report = html.replace('"use strict";', '"use strict"; onerror = m => document.title = "ERROR " + m;')
    wrapper = (
        f'<!doctype html><meta charset="utf-8"><body><iframe style="width:{width}px;height:900px;border:0" '
        f'srcdoc="{escape(report)}"></iframe><script>{script}</script></body>'
    )
    path = folder / f"probe_{width}_{dark}.html"
    path.write_text(wrapper, encoding="utf-8")
    mode = f"--blink-settings=preferredColorScheme={int(not dark)}"
    command = [CHROMIUM, *FLAGS, mode, f"--user-data-dir={folder / f'profile_{width}_{dark}'}", path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    body = done.stdout[done.stdout.index("<body>") + 6 : done.stdout.rindex("</body>")]
    return json.loads(unescape(body))


def page(finished: Finished) -> str:
    return (finished.folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module", params=[390, 1280], ids=["phone", "desk"])
def width(request):
    return request.param


@pytest.mark.slow
@pytest.mark.parametrize("fixture", ["block_run", "check_run", "antimeridian_run"])
def test_it_opens_without_errors_and_nothing_overflows_or_overlaps(fixture, width, request, tmp_path):
    finished = request.getfixturevalue(fixture)
    found = probe(page(finished), width, tmp_path)
    assert found["title"] == f"barpc: {finished.summary['headline']}"
    assert found["errors"] == []
    assert found["charts"] > 3
    assert found["hidden"] == found["unnamed"] == 0
    assert found["width"] <= width
    assert found["wide"] == []
    assert found["outside"] == []
    assert found["overlaps"] == []


@pytest.mark.slow
def test_tables_sort_up_and_down_and_say_so(block_run, tmp_path):
    found = probe(page(block_run), 1280, tmp_path)
    counts = sorted(view["num_observations"] for view in block_run.summary["views"])
    assert list(map(int, found["up"])) == counts
    assert list(map(int, found["down"])) == counts[::-1]
    assert found["names"] == sorted(view["name"] for view in block_run.summary["views"])
    assert (found["sorted"], found["unsorted"]) == ("ascending", "none")
    assert found["focus"]
    assert found["scrolled"] > 60
    assert 0 <= found["sticky"] < 3  # the heads stay on top


@pytest.mark.slow
def test_it_is_light_by_day_and_dark_by_night(block_run, tmp_path):
    day, night = (probe(page(block_run), 600, tmp_path, dark)["colors"] for dark in (False, True))
    assert day == ["rgb(27, 31, 36)", "rgb(255, 255, 255)"]
    assert night == ["rgb(230, 237, 243)", "rgb(13, 17, 23)"]


@pytest.mark.slow  # as what it is used for
def test_the_probe_does_see_overflow_overlap_and_errors(block_run, tmp_path):
    broken = page(block_run).replace(
        "</svg>", '<text x="400" y="20">overlapping words</text><text x="401" y="22">x</text></svg>', 1
    )
    broken = broken.replace("</script>", "nonsense();</script>")
    found = probe(broken, 390, tmp_path)
    assert found["outside"]
    assert found["overlaps"]
    assert found["title"].startswith("ERROR")
