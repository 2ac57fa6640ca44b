"""Draw docs/figures/reference.png: a reference of another season, and an image over it before and after.

python docs/figures/reference.py

A rendered scene of 0.5 m, a reference of 0.5 m, cameras off by 8 m (one sigma of each component).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1]))

from barpc.base.options import RunOptions  # noqa: E402
from barpc.pipeline import adjust  # noqa: E402
from barpc.rasters.dem import Dem  # noqa: E402
from barpc.tie.patches.channels import Patch, Sheet, picture  # noqa: E402
from tests.scenes import ImageOptions, Scene, write_scene  # noqa: E402
from tests.scenes.season import other_season, write_dem, write_reference  # noqa: E402

SIDE, TILE, SEED = 320, 40, 2  # px
WORDS = "reference, another season", "image on it, as delivered", "image on it, adjusted"


def grey(picture: np.ndarray) -> np.ndarray:
    """Stretched to bytes."""
    low, high = np.percentile(picture, [1, 99])
    return (255 * np.clip((picture - low) / max(high - low, 1e-6), 0, 1)).astype(np.uint8)


def main() -> None:
    """Render, adjust and draw."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = Scene(ImageOptions(size=(700, 700), seed=SEED, attitude=8.0 / 694e3))
        write_scene(folder / "scene", scene.options)
        write_dem(folder / "dem.tif", scene, SEED)
        sheet = write_reference(folder / "reference.tif", scene, other_season(scene, SEED, changed=0.1), 0.5)
        images = sorted((folder / "scene").glob("view*.tif"))
        options = RunOptions(reference=(str(sheet),), dem=str(folder / "dem.tif"))
        result = adjust(images, folder / "adjusted", options)
        terrain = Dem.open(folder / "dem.tif")
        delivered, adjusted = result.run.views[0], result.views[0]
        middle = delivered.sensor.localize(np.array(delivered.size) / 2.0, np.array(scene.options.alt))
        corner = middle[:2] + np.array([-0.5, 0.5]) * SIDE * 0.5 / np.array([78e3, 111e3])
        patch = Patch.on(terrain, corner, 0.5, (SIDE, SIDE), np.zeros(2))
        under = Sheet.read(str(sheet))
        shown = [picture(str(sheet), under.bands, under.size, under.image(patch.nodes()), patch.shape)[0]]
        seen = [patch.image(view) for view in (delivered, adjusted)]
        shown += [picture(delivered.path, (1,), delivered.size, at, patch.shape)[0] for at in seen]
    first, *others = map(grey, shown)
    rows, cols = np.indices(first.shape) // TILE
    panels = [first, *(np.where((rows + cols) % 2 == 0, first, other) for other in others)]
    for panel, words in zip(panels, WORDS, strict=True):
        cv2.rectangle(panel, (0, 0), (SIDE, 20), 0, -1)
        cv2.putText(panel, words, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255, 1, cv2.LINE_AA)
    gap = np.full((SIDE, 8), 255, np.uint8)
    drawn = np.hstack([panels[0], gap, panels[1], gap, panels[2]])
    cv2.imwrite(str(HERE / "reference.png"), drawn, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
