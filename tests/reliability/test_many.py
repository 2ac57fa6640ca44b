"""Hundreds of images: files are opened late and closed early, and nothing is held for each of them."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.rpcio import read_rpc, write_rpc_vrt

from .conftest import barpc, rewrite
from .trials import SAMPLES, crop

LIMIT = 128  # open files (ulimit -n)
COUNT = 300


def shifted(source: Path, folder: Path, count: int) -> list[Path]:
    """VRTs of an image in many shades, a chain of RPCs each a step east of the last: neighbours overlap."""
    rpc = read_rpc(source)
    step = 0.002  # deg: a little less than the image is wide
    found = []
    for n in range(count):
        offset = rpc.ground_offset + np.array([step * n, 0.0, 0.0])
        path = folder / f"view_{n:04d}.vrt"
        shade = rewrite(Path(shutil.copy(source, path.with_suffix(".tif"))), pixels=lambda v, n=n: v + n)
        write_rpc_vrt(replace(rpc, ground_offset=offset), shade, path)
        found.append(path)
    return found


PROGRAM = """
import json, resource, sys, threading
from pathlib import Path
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]),) * 2)
from barpc.pipeline import load_views
from barpc.tie import TieOptions
from tests.tie.stages import detect
from barpc.rasters.raster import hashed
most, over = 0, threading.Event()
def watch():
    global most
    while not over.wait(0.002):
        most = max(most, len(list(Path("/proc/self/fd").iterdir())))
threading.Thread(target=watch, daemon=True).start()
loaded = load_views(sorted(Path(sys.argv[2]).glob("*.vrt")))
prints = {hashed(view.path).key for view in loaded.views}
found = detect(loaded.views, TieOptions())
over.set()
usage = resource.getrusage(resource.RUSAGE_SELF)
told = {"views": len(found), "keypoints": min(len(k) for k in found), "prints": len(prints), "files": most}
status = Path("/proc/self/status").read_text()  # ru_maxrss begins with that of the process which started this one
peak = int(status.partition("VmHWM:")[2].split()[0]) / 1e3
print(json.dumps(told | {"mb": peak, "cpu": usage.ru_utime + usage.ru_stime}))
"""


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="open files are counted in /proc")
def test_images_without_number_are_read_with_few_open_files(tmp_path):
    source = crop(SAMPLES[0], tmp_path / "source.tif", side=128)
    shifted(source, tmp_path, COUNT)
    command = [sys.executable, "-c", PROGRAM, str(LIMIT), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=3600)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["views"], told["prints"]) == (COUNT, COUNT)
    assert told["keypoints"] > 0
    assert told["files"] < LIMIT / 2
    assert told["mb"] < 300
    print(told)


@pytest.mark.slow
def test_one_bad_image_of_many_is_named_and_left_out_when_asked(pristine, tmp_path):
    bad = tmp_path / "bad.tif"
    bad.write_text("hello")
    said = barpc("adjust", *pristine, bad, "-o", tmp_path / "out")
    assert said.code == 1
    assert "bad.tif" in said.err
    assert not (tmp_path / "out").exists()
    said = barpc("adjust", *pristine, bad, "-o", tmp_path / "out", "--keep-going", "--json")
    assert said.code == 3
    assert "bad.tif" in said.err
    assert (tmp_path / "out/view_00.vrt").exists()
    summary = json.loads(said.out)
    assert [Path(left["path"]).name for left in summary["left_out"]] == ["bad.tif"]
    assert len(summary["views"]) == 3
