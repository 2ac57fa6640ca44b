"""Real sets end good, and their cameras meet independent points as one shift a pair does, or better.

The points are those of `tools/ncc_check.py` beside the data: no barpc in them. All of them count.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import real_crops

pytestmark = pytest.mark.slow


@pytest.mark.costs(7)
@pytest.mark.parametrize(
    ("name", "parts"),
    [
        pytest.param("whole", ((0, 1, 2), (0, 1), (0, 2), (1, 2)), marks=pytest.mark.nightly),
        ("north", ((0, 1, 2),)),
        ("ventoux", ((0, 1),)),
    ],
)
def test_a_real_set_is_good_and_as_near_as_a_shift(
    name: str,
    parts: tuple[tuple[int, ...], ...],
    shared_data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As a whole, and its pairs."""
    monkeypatch.setattr(real_crops, "STEP", 16 if name == "ventoux" else 24)  # fewer points than the benchmark's
    tool = real_crops.load_tool(shared_data.parent / "tools/ncc_check.py")
    scene = next(one for one in real_crops.sets(shared_data) if one.name == name)
    assert not scene.missing
    block = real_crops.make_block(scene, tool, tmp_path)
    every = real_crops.whole(block)
    for images in parts:
        case = replace(every, windows={i: every.windows[i] for i in images})
        found = real_crops.run(block, tool, (), None, case)
        assert (found.code, found.said) == (0, "good")
        assert len(found.pairs) == len(images) * (len(images) - 1) // 2
        for pair in found.pairs:
            assert abs(pair.median) <= real_crops.MEDIAN + pair.error
        assert found.band <= real_crops.BAND + min(pair.error for pair in found.pairs)
