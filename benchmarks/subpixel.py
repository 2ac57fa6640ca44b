"""Tie points below a pixel: the mean error of a registered patch by sub-pixel phase, and against other detectors.

    python benchmarks/subpixel.py DATA             both tables (DATA: the folder of the shared test data)
    python benchmarks/subpixel.py DATA --only pairs

*Shifts*: real texture, shifted by known parts of a pixel. `means`: every fifth pixel of the image's 5 x 5 means, begun
at another pixel, so that nothing is interpolated and the truth is exact, aliases and all; `fourier`, `spline` and
`lanczos` interpolate. With noise, with a scale and a shear between the two, on a slope (a parallax that grows with the
place), and with the roles of the two exchanged. Figures are the mean error of all patches [px], the largest of all
phases, and its own standard deviation (patches overlap: at most twice that); outliers do not hide in a median.

*Pairs*: at the tie points of real pairs, what registration says across the epipolar line minus what others say at the
same places: the peak of the correlation of patches resampled to eighths of a pixel, least squares written for this page
(forward, symmetric, sampled by splines), the phase of the cross spectrum, and the method of the check points; and at
the check points what they say themselves. The mean difference and its standard deviation [px].
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402
from scipy import ndimage  # noqa: E402

from barpc.base.options import TieOptions  # noqa: E402
from barpc.pipeline.loading import load_views  # noqa: E402
from barpc.tie import find_tracks  # noqa: E402
from barpc.tie.pairing.epipolar import epipolar_segments, linear_map  # noqa: E402
from barpc.tie.patches.register import MIN_CORRELATION, PATCH, register_patches  # noqa: E402
from tests.tie.stages import common_tracks  # noqa: E402

warnings.simplefilter("ignore")
PAIRS = (
    ("phr_triplet_north", "img_01", "img_02"),
    ("phr_triplet_north", "img_01", "img_03"),
    ("phr_triplet_north", "img_02", "img_03"),
    ("phr_ventoux", "left_image", "right_image"),
)
Array = np.ndarray
Shifted = tuple[Array, Array, Callable[[Array], Array]]
"""Two images, and where places (N, 2) of the first are in the second."""
MEANS = 5  # px a side


def pixels(path: Path) -> Array:
    """The grey values of an image."""
    with rasterio.open(path) as file:
        return np.asarray(file.read(1), np.float64)


# --- shifts -------------------------------------------------------------------------------------------------


def means(image: Array, phase: Array) -> Shifted:
    """Means of whole pixels, the second begun `MEANS` times the phase (x, y) later."""
    begin = np.rint(MEANS * phase).astype(int)
    both = []
    for col, row in ((0, 0), begin):
        part = image[row:, col:]
        height, width = (n // MEANS for n in part.shape)
        blocks = part[: height * MEANS, : width * MEANS].reshape(height, MEANS, width, MEANS)
        both.append(blocks.mean(axis=(1, 3)))
    return both[0], both[1], lambda xy: xy - begin / MEANS


def fourier(image: Array, phase: Array) -> Shifted:
    """Shifted by the phase of the spectrum."""
    moved = np.fft.ifft2(ndimage.fourier_shift(np.fft.fft2(image), -phase[::-1])).real
    return image, moved, lambda xy: xy - phase


def spline(image: Array, phase: Array) -> Shifted:
    """Shifted by a quintic spline."""
    return image, ndimage.shift(image, -phase[::-1], order=5, mode="mirror"), lambda xy: xy - phase


def lanczos(image: Array, phase: Array) -> Shifted:
    """Shifted by a Lanczos kernel of 16 taps."""
    out = image
    for axis, part in ((1, phase[0]), (0, phase[1])):
        tap = np.arange(-8, 9)
        kernel = np.sinc(tap - part) * np.sinc((tap - part) / 8)
        out = ndimage.correlate1d(out, kernel / kernel.sum(), axis=axis, mode="mirror")
    return image, out, lambda xy: xy - phase


def warped(slope: float) -> Callable[[Array, Array], Shifted]:
    """Scaled by 1.02 and sheared, or on a slope: then the parallax (along rows) grows with the place, and bends."""

    def make(image: Array, phase: Array) -> Shifted:
        height, width = image.shape
        y, x = np.mgrid[:height, :width].astype(np.float64)
        a = np.array([[1.0, slope], [0.0, 1.0]]) if slope else np.array([[1.02, 0.01], [-0.015, 0.99]])
        middle = 0.5 * np.array([width, height])
        bend = 1e-3 if slope else 0.0  # px of parallax per px^2: a relief of 5 px over a patch's side of 100

        def back(xy: Array) -> Array:  # second -> first
            at = (xy - middle) @ a.T + middle + phase
            return at + np.stack([bend * 20.0 * np.sin(xy[..., 1] / 20.0), 0.0 * xy[..., 0]], axis=-1)

        source = back(np.stack([x, y], axis=-1))
        second = ndimage.map_coordinates(image, [source[..., 1], source[..., 0]], order=5, mode="mirror")

        def where(xy: Array) -> Array:  # first -> second, by iteration
            found = xy.copy()
            for _ in range(30):
                found = found + (xy - back(found))
            return found

        return image, second, where

    return make


def lens(image: Array, phase: Array) -> Shifted:
    """Means of an image that is blurred first, by a lens that passes an eighth of the finest lines' contrast."""
    return means(ndimage.gaussian_filter(image, 0.58 * MEANS), phase)


KINDS: dict[str, tuple[Callable[[Array, Array], Shifted], float, bool]] = {
    "means": (means, 0.0, False),
    "means, exchanged": (means, 0.0, True),
    "means, a lens": (lens, 0.0, False),
    "means, a lens, noise": (lens, 0.05, False),
    "fourier": (fourier, 0.0, False),
    "spline": (spline, 0.0, False),
    "lanczos": (lanczos, 0.0, False),
    "scale and shear": (warped(0.0), 0.0, False),
    "scale and shear, exchanged": (warped(0.0), 0.0, True),
    "slope": (warped(0.15), 0.0, False),
    "slope, exchanged": (warped(0.15), 0.0, True),
}
"""Name -> how the second image is made, noise in standard deviations of the grey values, roles exchanged."""


def phases(kind: str) -> Iterator[Array]:
    """Parts of a pixel: along either axis, and along both."""
    steps = np.arange(0.0, 1.0, 1.0 / MEANS if kind.startswith("means") else 0.1)
    for step in steps:
        yield from (np.array([step, 0.0]), np.array([0.0, step]), np.array([step, step]))


def errors(
    first: Array, second: Array, where: Callable[[Array], Array], exchanged: bool, checks: bool = False
) -> Array:
    """Errors (N, 2) [px] of the patches of a grid that registration takes, or the method of the check points."""
    margin, pitch = 24, 9
    axes = (np.arange(margin, n - margin, pitch) for n in first.shape[::-1])
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2).astype(np.float64)
    step = 0.5
    columns = [where(grid + step * d) - where(grid - step * d) for d in np.eye(2)]
    truth, linear = where(grid), np.stack(columns, axis=-1)
    if exchanged:  # the reference is a whole pixel of what was the second image
        at = np.rint(truth)
        back = np.linalg.inv(linear)
        target = grid.copy()
        for _ in range(30):
            target += ((at - where(target))[:, None] @ back.transpose(0, 2, 1))[:, 0]
        first, second, grid, truth, linear = second, first, at, target, back
    images = first.astype(np.float32), second.astype(np.float32)
    if checks:
        off = by_parabolas(images, grid, np.rint(truth)) - truth
        return off[np.isfinite(off).all(axis=1)]
    valid = np.ones(first.shape, bool), np.ones(second.shape, bool)
    found = register_patches(images, valid, grid, np.rint(truth), np.rint(linear), PATCH)
    good = found.ok & (found.correlation >= MIN_CORRELATION)
    return np.asarray((found.xy - truth)[good])


def shifts(data: Path) -> None:
    """The table of known shifts."""
    print("| shifted | patches a phase | largest mean error x, y | its standard deviation | RMS of a patch |")
    print("|---|---|---|---|---|")
    images = [pixels(data / f"optical/phr_triplet_north/{name}.tif") for name in ("img_01", "img_02")]
    cases = [(kind, *case, False) for kind, case in KINDS.items()]
    cases += [(f"{kind}: as check points", *KINDS[kind], True) for kind in ("means, a lens", "fourier", "slope")]
    for kind, make, noise, exchanged, checks in cases:
        rng, rows = np.random.default_rng(0), []
        for phase in phases(kind):
            off = []
            for image in images * (8 if noise else 1):
                part = image if kind.startswith("means") else image[100:420, 100:520]
                first, second, where = make(part, phase)
                both = [one + noise * one.std() * rng.normal(size=one.shape) for one in (first, second)]
                off.append(errors(*both, where, exchanged, checks))
            one = np.concatenate(off)
            rows.append((len(one), *one.mean(axis=0), *(one.std(axis=0) / len(one) ** 0.5), np.sqrt((one**2).mean())))
        table = np.array(rows)
        worst = np.abs(table[:, 1:3]).argmax(axis=0)
        mean = [table[worst[k], 1 + k] for k in (0, 1)]
        sd = [table[worst[k], 3 + k] for k in (0, 1)]
        print(
            f"| {kind} | {table[:, 0].mean():.0f} | {mean[0]:+.4f}, {mean[1]:+.4f} | {sd[0]:.4f}, {sd[1]:.4f} "
            f"| {table[:, 5].mean():.4f} |",
            flush=True,
        )


# --- other detectors ----------------------------------------------------------------------------------------


def patch_of(coefficients: Array, centre: Array, linear: Array, half: int) -> Array:
    """A patch of an image's quintic spline about a place, on axes turned by `linear`."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    at = centre[:, None, None] + np.tensordot(linear, np.stack([x, y]), axes=1)
    return np.asarray(ndimage.map_coordinates(coefficients, at[::-1], order=5, mode="mirror", prefilter=False))


def by_correlation(pair: tuple[Array, Array], a: Array, b: Array, linear: Array, half: int = 10) -> Array:
    """The best correlation of a patch among those of eighths of a pixel, and the parabola there."""
    template = patch_of(pair[0], a, np.eye(2), half)
    template = template - template.mean()
    step, reach, best = 1.0, 3, np.zeros(2)
    score: Array = np.zeros((3, 3))
    while step >= 0.125:
        axis = step * np.arange(-reach, reach + 1)
        score = np.array(
            [[_alike(template, pair[1], b, linear, np.add(best, (x, y)), half) for x in axis] for y in axis]
        )
        row, col = np.unravel_index(score.argmax(), score.shape)
        best = np.add(best, (axis[col], axis[row]))
        if not (0 < row < 2 * reach and 0 < col < 2 * reach):
            return np.full(2, np.nan)
        score, step, reach = score[row - 1 : row + 2, col - 1 : col + 2], step / 2, 2
    top = [
        2 * step * 0.5 * (low - high) / (low - 2 * score[1, 1] + high)
        for low, high in ((score[1, 0], score[1, 2]), (score[0, 1], score[2, 1]))
    ]
    return np.asarray(b + linear @ (best + top))


def _alike(template: Array, image: Array, b: Array, linear: Array, off: Array, half: int) -> float:
    other = patch_of(image, b + linear @ off, linear, half)
    other = other - other.mean()
    return float((template * other).sum() / np.sqrt((template**2).sum() * (other**2).sum()))


def by_least_squares(pair: tuple[Array, Array], a: Array, b: Array, linear: Array, half: int = 10) -> Array:
    """Least squares with shift, distortion, gain and bias; each image takes half of the distortion and shift."""
    y, x = (part.ravel() / half for part in np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64))
    weight = np.exp(-0.25 * (x**2 + y**2) / 0.7**2)
    shift, turn = np.zeros(2), np.zeros((2, 2))
    for _ in range(30):
        first = patch_of(pair[0], a - 0.5 * shift, np.eye(2) - 0.5 * turn, half)
        second = patch_of(pair[1], b + 0.5 * linear @ shift, linear @ (np.eye(2) + 0.5 * turn), half)
        one, two = ((p - p.mean()) / p.std() for p in (first, second))
        by = [0.5 * (np.gradient(one, axis=k) + np.gradient(two, axis=k)).ravel() for k in (1, 0)]
        columns = [by[0], by[1], by[0] * x, by[0] * y, by[1] * x, by[1] * y, two.ravel(), np.ones(two.size)]
        design = np.stack(columns, axis=1) * weight[:, None]
        step = np.linalg.lstsq(design, weight * (one - two).ravel(), rcond=None)[0]
        shift, turn = shift + step[:2], turn + step[2:6].reshape(2, 2) / half
        if np.hypot(*step[:2]) < 1e-3:
            break
    else:
        return np.full(2, np.nan)
    if np.hypot(*shift) > 2.0:
        return np.full(2, np.nan)
    whole = linear @ (np.eye(2) + 0.5 * turn) @ np.linalg.inv(np.eye(2) - 0.5 * turn)  # first -> second about them
    return np.asarray(b + 0.5 * linear @ shift + whole @ (0.5 * shift))


def by_phase(pair: tuple[Array, Array], a: Array, b: Array, linear: Array, half: int = 16) -> Array:
    """The plane through the phases of the cross spectrum, those of low frequencies that both hold."""
    shift, size = np.zeros(2), 2 * half + 1
    window = np.outer(np.hanning(size), np.hanning(size))
    freq = np.fft.fftfreq(size)
    fy, fx = np.meshgrid(freq, freq, indexing="ij")
    low = (np.hypot(fx, fy) < 0.25) & ((fx != 0) | (fy != 0))
    for _ in range(10):
        one = patch_of(pair[0], a, np.eye(2), half)
        two = patch_of(pair[1], b + linear @ shift, linear, half)
        cross = np.fft.fft2((one - one.mean()) * window) * np.fft.fft2((two - two.mean()) * window).conj()
        weight = np.abs(cross[low])
        design = 2 * np.pi * np.stack([fx[low], fy[low]], axis=1)
        normal = design.T @ (design * weight[:, None])
        # |cross| sin(phase): bounded, and the phase itself where it is small
        step = np.linalg.solve(normal, design.T @ cross[low].imag)
        shift = shift + step
        if np.hypot(*step) < 1e-3:
            break
    return np.asarray(b + linear @ shift) if np.hypot(*shift) < 2.0 else np.full(2, np.nan)


def by_parabolas(images: Sequence[Array], a: Array, b: Array, half: int = 15, reach: int = 3) -> Array:
    """As the check points were made: rigid patches of 31 px, correlated at whole pixels; parabolas there."""
    out = np.full(a.shape, np.nan)
    for k, ((ax, ay), (bx, by)) in enumerate(zip(a.astype(int), b.astype(int), strict=True)):
        wide = half + reach
        if min(ax, ay) < half or min(bx, by) < wide:
            continue
        template = images[0][ay - half : ay + half + 1, ax - half : ax + half + 1]
        area = images[1][by - wide : by + wide + 1, bx - wide : bx + wide + 1]
        if template.shape != (2 * half + 1,) * 2 or area.shape != (2 * wide + 1,) * 2:
            continue
        s = cv2.matchTemplate(area, template, cv2.TM_CCOEFF_NORMED).astype(np.float64)
        y, x = np.unravel_index(s.argmax(), s.shape)
        if min(x, y) > 0 and max(x, y) < 2 * reach:
            part = [
                0.5 * (low - high) / (low - 2 * s[y, x] + high)
                for low, high in ((s[y, x - 1], s[y, x + 1]), (s[y - 1, x], s[y + 1, x]))
            ]
            out[k] = bx + x - reach + part[0], by + y - reach + part[1]
    return out


OTHERS = {"correlation": by_correlation, "least squares": by_least_squares, "phase": by_phase}


def pairs(data: Path) -> None:
    """The table of real pairs."""
    print("\n| pair | places | minus | n | along | across |\n|---|---|---|---|---|---|")
    for folder, *names in PAIRS:
        paths = [data / f"optical/{folder}/{name}.tif" for name in names]
        views = load_views(paths).views
        images = [pixels(path) for path in paths]
        splines = tuple(ndimage.spline_filter(image, 5, mode="mirror") for image in images)
        a, b = common_tracks(find_tracks(views, TieOptions(points_per_image=1500)).tracks, 0, 1)
        whole = np.rint(a)
        linear = linear_map(views[0], views[1], whole)
        start = b + (linear @ (whole - a)[:, :, None])[:, :, 0]
        table = np.genfromtxt(
            data / f"truth/ties/{folder}__{names[0]}__{names[1]}__ncc_check.csv", delimiter=",", names=True
        )
        checks = [np.stack([table[f"col_{k}"], table[f"row_{k}"]], axis=1) for k in "ab"]
        name = f"{names[0]} - {names[1]}"
        mine, good = registered(images, whole, start, linear)
        place = epipolar_segments(views[0], views[1], whole)
        for other, find in OTHERS.items():
            theirs = np.array(
                [find(splines, *one) for one in zip(whole, np.rint(start), linear, strict=True)]  # type: ignore[operator]
            )
            row(name, "tie points", other, place.errors(mine) - place.errors(theirs), good)
        simple = by_parabolas([image.astype(np.float32) for image in images], whole, np.rint(start))
        row(name, "tie points", "as check points", place.errors(mine) - place.errors(simple), good)
        place, linear = epipolar_segments(views[0], views[1], checks[0]), linear_map(views[0], views[1], checks[0])
        mine, good = registered(images, checks[0], checks[1], linear)
        row(name, "check points", "themselves", place.errors(mine) - place.errors(checks[1]), good)
        for other, find in OTHERS.items():
            theirs = np.array([find(splines, *one) for one in zip(*checks, linear, strict=True)])  # type: ignore[operator]
            row(name, "check points", other, place.errors(mine) - place.errors(theirs), good)


def registered(images: list[Array], at: Array, start: Array, linear: Array) -> tuple[Array, Array]:
    """Places (N, 2) by registration, and whether it takes them."""
    valid = tuple(np.ones(image.shape, bool) for image in images)
    pictures = tuple(image.astype(np.float32) for image in images)
    found = register_patches(pictures, valid, at, start, linear, PATCH)  # type: ignore[arg-type]
    return found.xy, found.ok & (found.correlation >= MIN_CORRELATION)


def row(name: str, places: str, other: str, off: Array, good: Array) -> None:
    """The mean difference of those that are not far from the others, and its standard deviation."""
    off = off[good & np.isfinite(off).all(axis=1)]
    apart = np.abs(off - np.median(off, axis=0))
    off = off[(apart <= 4 * 1.4826 * np.median(apart, axis=0) + 0.02).all(axis=1)]
    mean, sd = off.mean(axis=0), off.std(axis=0) / len(off) ** 0.5
    figures = " | ".join(f"{m:+.4f} ± {s:.4f}" for m, s in zip(mean, sd, strict=True))
    print(f"| {name} | {places} | {other} | {len(off)} | {figures} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", choices=["shifts", "pairs"])
    given = parser.parse_args()
    if given.only != "pairs":
        shifts(given.data)
    if given.only != "shifts":
        pairs(given.data)


if __name__ == "__main__":
    main()
