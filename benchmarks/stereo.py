"""Dense stereo before and after: OpenCV's semi-global matching on one pair, with the cameras as delivered and adjusted.

Both images are resampled along the epipolar lines that the cameras promise (one affine epipolar geometry, as it fits a
crop of a kilometre). Then, with each pair of cameras:
  dy     what a correlation search up and down finds between the two resampled images [px]: 0 where cameras agree
  valid  share of pixels, of those that both images can see, whose disparity passes the left-right check
The heights to search are those of the run's tie points, 20 m more on both sides.

python benchmarks/stereo.py LEFT RIGHT ADJUSTED       where ADJUSTED is the output of barpc adjust LEFT RIGHT
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from barpc import read_rpc
from barpc.rasters.raster import open_raster

MARGIN = 20.0
PATCH = 10


def image_of(path: str | Path) -> np.ndarray:
    """Band 1, stretched to 8 bits."""
    with open_raster(path) as dataset:
        pixels = dataset.read(1).astype(np.float64)
    low, high = np.percentile(pixels[pixels > 0], [0.5, 99.5])
    return np.clip(np.rint(254 * (pixels - low) / (high - low)) + 1, 1, 255).astype(np.uint8)


def heights(run: Path) -> tuple[float, float]:
    """Altitudes of the run's tie points [m]."""
    with (run / "tables/residuals.csv").open(encoding="utf-8", newline="") as stream:
        lines = [line for line in stream if not line.startswith("#")]
    alt = [float(row["height_above_datum"]) for row in csv.DictReader(lines)]
    low, high = np.percentile(alt, [1, 99])
    return float(low) - MARGIN, float(high) + MARGIN


def virtual_matches(cameras, sizes, alts):
    """Where both cameras say that points of a grid in the first image lie in the second, at several altitudes."""
    width, height = sizes[0]
    grid = np.meshgrid(np.linspace(0, width - 1, 20), np.linspace(0, height - 1, 20), np.linspace(*alts, 5))
    xy = np.stack([grid[0].ravel(), grid[1].ravel()], axis=1)
    other = cameras[1].project(cameras[0].localize(xy, grid[2].ravel()))
    inside = ((other >= 0) & (other <= np.array(sizes[1]) - 1)).all(axis=1)
    return xy[inside], other[inside], grid[2].ravel()[inside]


def rectification(cameras, sizes, alts):
    """Two 2 x 3 maps to images whose rows are the epipolar lines, and the range of disparities."""
    a, b, alt = virtual_matches(cameras, sizes, alts)
    rows = np.hstack([a, b])
    mean = rows.mean(axis=0)
    n = np.linalg.svd(rows - mean, full_matrices=False)[2][-1]  # n . (a, b) = n . mean: affine epipolar geometry
    n = n if n[1] > 0 else -n
    k = np.sqrt(np.hypot(*n[:2]) * np.hypot(*n[2:]))
    left = np.array([[n[1], -n[0], 0.0], [n[0], n[1], -n[:2] @ mean[:2]]]) / np.array([[np.hypot(*n[:2])], [k]])
    y_b = -(b - mean[2:]) @ n[2:] / k
    x_a = a @ left[0, :2]
    middle = abs(alt - np.mean(alts)) < 1
    system = np.column_stack([b, np.ones(len(b))])
    right_x = np.linalg.lstsq(system[middle], x_a[middle], rcond=None)[0]
    right = np.array([right_x, [-n[2] / k, -n[3] / k, n[2:] @ mean[2:] / k]])
    assert np.allclose(system @ right[1], y_b)
    disparity = x_a - system @ right_x
    return left, right, (float(disparity.min()), float(disparity.max()))


def resample(images, left, right):
    """Both images along the epipolar lines, 0 outside, on one common window."""
    corners = []
    for image, matrix in zip(images, (left, right), strict=True):
        h, w = image.shape
        corners.append(np.array([[0, 0], [w, 0], [0, h], [w, h]]) @ matrix[:, :2].T + matrix[:, 2])
    low = np.maximum(corners[0].min(axis=0), corners[1].min(axis=0)) - 64
    size = np.minimum(corners[0].max(axis=0), corners[1].max(axis=0)) + 64 - low
    moved = [np.column_stack([m[:, :2], m[:, 2] - low]) for m in (left, right)]
    shape = (int(size[0]), int(size[1]))
    return [cv2.warpAffine(i, m, shape, flags=cv2.INTER_CUBIC) for i, m in zip(images, moved, strict=True)]


def vertical_offsets(a, b, disparities):
    """Vertical offset of patches of a in b [px], where their correlation exceeds 0.8."""
    reach, found = 12, []
    low, high = int(np.floor(disparities[0])) - 2, int(np.ceil(disparities[1])) + 2
    for y in range(PATCH + reach, a.shape[0] - PATCH - reach, 2 * PATCH):
        for x in range(PATCH + max(high, 0), a.shape[1] - PATCH + min(low, 0), 2 * PATCH):
            patch = a[y - PATCH : y + PATCH + 1, x - PATCH : x + PATCH + 1]
            window = b[y - PATCH - reach : y + PATCH + reach + 1, x - high - PATCH : x - low + PATCH + 1]
            if window.shape[1] < 2 * PATCH + 4 or (patch == 0).any() or (window == 0).any() or patch.std() < 8:
                continue
            score = cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED)
            row, col = np.unravel_index(score.argmax(), score.shape)
            if score[row, col] > 0.8 and 0 < row < score.shape[0] - 1:
                above, at, below = score[row - 1 : row + 2, col]
                found.append(row - reach + 0.5 * (above - below) / (above - 2 * at + below))
    return np.array(found)


def valid_share(a, b, disparities):
    """Share of the pixels seen by both whose disparity survives the left-right check."""
    low = int(np.floor(disparities[0])) - 2
    count = 16 * int(np.ceil((disparities[1] + 2 - low) / 16))
    options = {"numDisparities": count, "blockSize": 5, "P1": 200, "P2": 800, "uniquenessRatio": 5}
    options |= {"speckleWindowSize": 50, "speckleRange": 2, "mode": cv2.STEREO_SGBM_MODE_HH}
    there = cv2.StereoSGBM.create(minDisparity=low, **options).compute(a, b) / 16.0
    back = cv2.StereoSGBM.create(minDisparity=-low - count + 1, **options).compute(b, a) / 16.0
    rows, cols = np.indices(a.shape)
    ok = there > low - 0.5
    target = np.clip(np.rint(cols - there).astype(int), 0, a.shape[1] - 1)
    ok &= abs(there + back[rows, target]) <= 1
    sees = (a > 0) & (b[rows, np.clip(cols - int(np.mean(disparities)), 0, a.shape[1] - 1)] > 0)
    sees[:, : low + count] = False  # OpenCV does not search where the range leaves the image
    return float((ok & sees).sum() / sees.sum())


@dataclass(frozen=True)
class Measure:
    """What a pair of cameras is worth to dense matching."""

    patches: int
    offset: float
    spread: float
    far: float
    valid: float


def measure(images: Sequence[str | Path], sources: Sequence[str | Path], run: Path) -> Measure:
    """Resample two images along the epipolar lines of the cameras in `sources`, and match."""
    pixels = [image_of(path) for path in images]
    sizes = [(image.shape[1], image.shape[0]) for image in pixels]
    left, right, disparities = rectification([read_rpc(source) for source in sources], sizes, heights(run))
    a, b = resample(pixels, left, right)
    dy = vertical_offsets(a, b, disparities)
    middle = float(np.median(dy))
    spread = 1.4826 * float(np.median(abs(dy - middle)))
    return Measure(len(dy), middle, spread, float(np.mean(abs(dy) > 0.5)), valid_share(a, b, disparities))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("left")
    parser.add_argument("right")
    parser.add_argument("adjusted", type=Path)
    arguments = parser.parse_args()
    images = [arguments.left, arguments.right]
    after = [arguments.adjusted / f"{Path(path).stem}.vrt" for path in images]
    print("heights {:.0f} .. {:.0f} m".format(*heights(arguments.adjusted)))
    print(f"{'cameras':12}{'patches':>8}{'dy median':>11}{'dy spread':>11}{'|dy| > 0.5':>12}{'valid':>8}")
    for name, sources in (("delivered", images), ("adjusted", after)):
        m = measure(images, sources, arguments.adjusted)
        print(f"{name:12}{m.patches:8}{m.offset:+11.3f}{m.spread:11.3f}{m.far:12.1%}{m.valid:8.1%}")


if __name__ == "__main__":
    main()
