"""Rasters that tests and benchmarks write."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning


def write_image(path: Path, pixels: np.ndarray, **profile: object) -> Path:
    """Write pixels (H, W) or (bands, H, W), as a GeoTIFF if no driver is given; keywords go to rasterio."""
    bands = pixels.reshape(-1, *pixels.shape[-2:])
    size = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **{"driver": "GTiff", **size, "dtype": bands.dtype, **profile}) as out:
            out.write(bands)
    return path


def write_blank(path: Path, size: tuple[int, int], **profile: object) -> Path:
    """Write an image of `size` (width, height) of which no pixel is written, so that it takes no room."""
    shape = {"width": size[0], "height": size[1], "count": 1, "dtype": "uint8", "sparse_ok": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        rasterio.open(path, "w", **{"driver": "GTiff", **shape, **profile}).close()
    return path
