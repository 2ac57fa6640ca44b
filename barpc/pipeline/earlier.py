"""A finished run that images are added to: which images it has and where they lie, which of them new ones meet.

A run folder has `tables/images.json` beside its block: every image of the block, those of the runs that it went on
from too, so that no other folder is needed to go on.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import shapely

from barpc.ba import BlockPrior
from barpc.ba.parameters.unknowns import make_unknowns
from barpc.ba.result import moved_px
from barpc.base.errors import InputError, plain
from barpc.base.geodesy import Array, ecef_from_ground, metres_per_unit, wrap_longitude
from barpc.base.identity import Input, fingerprint
from barpc.base.options import RunOptions, TieOptions
from barpc.base.remote import is_url, location
from barpc.base.safe_io import GEOJSON, parse_json, read_text
from barpc.base.sealed import Sealed, portable
from barpc.cameras import split_spec
from barpc.pipeline.inputs import linked_names
from barpc.pipeline.loading import Image, LoadedViews, image_path, load_views
from barpc.pointio.names import unique_names
from barpc.report import Run
from barpc.report.finished import FinishedRun
from barpc.report.outcome import Added
from barpc.report.runfiles import IMAGES, PRIOR_FILE
from barpc.scene import BoolArray, Camera, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import footprints
from barpc.tie.pairing.overlaps import Footprints, forests, overlapping_pairs, reach_of

logger = logging.getLogger(__name__)

_WORSE = 1.2  # times the RMS of check tie points: 1.01 of real and simulated images, by chance 1.1
_OPENED_PER_NEIGHBOUR = 4  # times as many images as are matched are opened, the largest common areas: angles count, too


CorrectedViews = tuple[list[View], Sequence[SensorModel], Sequence[Camera]]


@dataclass(frozen=True)
class Known:
    """An image of a finished run."""

    name: str
    path: str  # absolute
    choices: Mapping[str, str] | None  # that its camera was opened with; None: it came with the image, from no file
    size: tuple[int, int]
    altitude: float  # [m] of its outline
    outline: tuple[tuple[float, float], ...]  # lon, lat [deg], by its corrected camera
    bytes: int
    sha256: str
    camera_sha256: str  # of the file that holds its camera; empty: no file
    calibration: str = ""  # SHA-256 of the calibration that it was adjusted with; empty: none

    @property
    def spec(self) -> str:
        """The file with the choices behind it."""
        return self.path + "".join(f",{key}={text}" for key, text in (self.choices or {}).items())


@dataclass(frozen=True, eq=False)
class Earlier:
    """A finished run, its images and the prior of their cameras, in one order."""

    run: FinishedRun
    images: tuple[Known, ...]
    prior: BlockPrior

    @classmethod
    def open(cls, folder: str | Path) -> Earlier:
        """Read a run folder; InputError where it is none, unfinished, of another release, or was changed since."""
        run = FinishedRun.open(folder)
        block, table = run.table(PRIOR_FILE), run.table(IMAGES)
        if not block.exists():
            raise InputError(f"{block}: missing, or of another release, and later runs start from it: run the "
                             "adjustment again")  # fmt: skip
        prior = BlockPrior.load(block)
        try:
            rows = parse_json(read_text(table, GEOJSON), GEOJSON.values)["images"]
            images = {row["name"]: _parse_known(row, run.sealed) for row in rows}
            return cls(run, tuple(images[name] for name in prior.names), prior)
        except (msgspec.ValidationError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(f"{table}: damaged ({plain(error)}); run the adjustment again") from error

    @property
    def folder(self) -> Path:
        """The run's folder, as given."""
        return self.run.folder

    @cached_property
    def number(self) -> dict[str, int]:
        """Name of an image -> its index."""
        return {image.name: i for i, image in enumerate(self.images)}

    def of_given(self, files: Sequence[Any]) -> dict[str, Known]:
        """Return which of the files given (absolute) are images of the run: by path, or under another by content."""
        by_path = {os.path.realpath(image.path): image for image in self.images if not is_url(image.path)}
        by_content = {(image.bytes, image.sha256): image for image in self.images}
        sizes, found = {image.bytes for image in self.images}, dict[str, Known]()
        for file in files:
            if not isinstance(file, Path) or not file.is_file():
                continue
            image = by_path.get(os.path.realpath(file))
            if image is None and file.stat().st_size in sizes:
                image = by_content.get((file.stat().st_size, fingerprint(file).sha256))
            if image is not None:
                found[str(file)] = image
        return found

    def near(self, views: Sequence[View], tie: TieOptions) -> list[int]:
        """Return the images whose outlines meet those of views that may be off, the largest common areas of each."""
        grown = Footprints(
            views, float(np.median([v.altitude for v in views])), [reach_of(v, tie.search) for v in views]
        )
        usable = [image for image in self.images if image.outline]
        rings = np.array([image.outline for image in usable]).reshape(len(usable), -1, 2)
        outlines = np.atleast_1d(np.asarray(shapely.polygons(grown.plane(rings)), dtype=object))
        tree, found = shapely.STRtree(outlines), set[int]()
        for outline in grown.outlines:
            index = tree.query(outline, predicate="intersects")
            area = shapely.area(shapely.intersection(tree.geometries[index], outline))
            best = np.lexsort((index, -area))[: _OPENED_PER_NEIGHBOUR * tie.neighbours]
            found.update(self.number[usable[i].name] for i in index[best])
        return sorted(found)

    def refuse_changed(self, run: Run, inputs: Mapping[str, Input]) -> None:
        """Raise InputError where an image of the run, or the file with its camera, was changed since."""
        for view, source in zip(run.views, run.sources, strict=True):
            image = self.images[self.number[view.name]] if view.name in self.number else None
            if image is not None and _sha(inputs, view.path) != image.sha256:
                raise InputError(
                    f"{view.path}: is not the image used by {self.folder} (it was changed since); give the "
                    "new one under another name"
                )
            used = run.calibrated.get(view.name)
            if image is not None and image.calibration != ("" if used is None else used.sha256):
                now = "none is given" if used is None else f"now it is {used.path}"
                raise InputError(
                    f"{view.path}: {self.folder} was made with {'another' if image.calibration else 'no'} calibration, "
                    f"{now}: give the same, or adjust all images together"
                )
            if image is not None and _sha(inputs, str(source.path)) != image.camera_sha256:
                raise self._other_camera(view, source)

    def _other_camera(self, view: View, source: Camera) -> InputError:
        return InputError(
            f"{source.path}: is not the camera of {view.path} used by {self.folder} (it was changed since); put the "
            "former one back, or adjust all images together"
        )

    def found(self, image: Known) -> Known:
        """Return an image with the places of its files now; InputError where no file has the content of one."""
        choices, ask = image.choices, self.run.sealed.input
        if choices is not None and "camera" in choices:
            camera = ask(portable(choices["camera"], self.folder), image.camera_sha256)
            choices = {**choices, "camera": camera}
        return replace(image, path=ask(portable(image.path, self.folder), image.sha256, image.bytes), choices=choices)

    def corrected(self, images: Sequence[Known], block: BlockPrior, hosts: Sequence[str] = ()) -> CorrectedViews:
        """Return images of the run as delivered, their corrected cameras by a block, and where the delivered came from.

        InputError where an image or its camera was changed since the run.
        """
        known = {image.path: image for image in map(self.found, images)}
        specs = [image.spec for image in known.values()]
        loaded = load_views(specs, min_views=1, distinct=False, hosts=hosts)
        for view, source in zip(loaded.views, loaded.sources, strict=True):
            sha = known[view.path].camera_sha256
            if sha and str(source.path) != view.path and fingerprint(source.path).sha256 != sha:
                raise self._other_camera(view, source)
        views = [replace(view, name=known[view.path].name) for view in loaded.views]
        number = {name: i for i, name in enumerate(block.names)}
        rows = np.array([number[view.name] for view in views])
        waves = block.waves(tuple(view.name for view in views))
        unknowns = make_unknowns(views, block.model, block.drift, block.center[rows], waves)
        return views, unknowns.corrected(block.params[rows], views), loaded.sources

    def moved(self, grown: BlockPrior) -> Array:
        """Return how far [px] the cameras of its images (n,) move, where a block has grown out of this."""
        lonlat = np.array([_outline_centre(image.outline) for image in self.images])
        alt = np.array([image.altitude for image in self.images])
        places = np.column_stack([lonlat, alt])
        side = [np.sqrt(_outline_area(image) / (image.size[0] * image.size[1])) for image in self.images]
        before = replace(self.prior, params=self.prior.as_written)
        return moved_px(before, grown, ecef_from_ground(places), np.array(side))


@dataclass(frozen=True, eq=False)
class GrowingRun(Run):
    """A run, which may add images to a finished one."""

    earlier: Earlier | None = None


def _sha(inputs: Mapping[str, Input], path: str) -> str:
    return inputs[path].sha256 if path in inputs else ""


def _parse_known(row: Mapping[str, Any], sealed: Sealed) -> Known:
    known = msgspec.convert(row, Known)
    if min(known.size) < 1:
        raise ValueError(f"{known.name}: no size")
    choices = known.choices
    if choices is not None and "camera" in choices:
        choices = {**choices, "camera": _found_at(choices["camera"], sealed)}
    return replace(known, path=_found_at(known.path, sealed), choices=choices)


def _found_at(path: str, sealed: Sealed) -> str:
    return path if not path or is_url(path) else str(sealed.located(path))


def _outline_centre(outline: Sequence[tuple[float, float]]) -> tuple[float, float]:
    ring = np.array(outline)
    return tuple(ring.mean(axis=0)) if len(ring) else (0.0, 0.0)


def _outline_area(image: Known) -> float:
    """Return the area of an outline [m^2]."""
    ring = np.array(image.outline).reshape(-1, 2)
    if not len(ring):
        return float(image.size[0] * image.size[1])
    ring = ring.copy()
    ring[:, 0] = wrap_longitude(ring[:, 0], ring[0, 0])
    scale = metres_per_unit(np.array([*ring[0], image.altitude]))[:2]
    return float(shapely.Polygon((ring - ring[0]) * scale).area)


# --- the images of a run that goes on ---------------------------------------------------------------------


def join_earlier(images: Sequence[Image], options: RunOptions, earlier: Earlier, how: dict[str, Any]) -> LoadedViews:
    """Return the images given and those of an earlier run that they meet, under the names that they have there.

    `how`: arguments of `load_views`. InputError where none of the images is new, or none meets the earlier ones.
    """
    files = [image_path(image, options.allow_remote) for image in images]
    how = {**how, "min_views": 1}
    old = earlier.of_given(files)
    fresh = [image for image, file in zip(images, files, strict=True) if str(file) not in old]
    if not fresh:
        file, image = next(iter(old.items()))
        raise InputError(
            f"every image given is in {earlier.folder} already ({file} is its {image.name}): there is none to add"
        )
    given = load_views(fresh, **how)
    names = {image.name for image in old.values()}
    wanted = [i for i in _needed_images(given.views, options, earlier) if earlier.images[i].name not in names]
    reached = _still_there([earlier.images[i] for i in wanted], earlier)
    if not reached and not old:
        where = "its images there cannot be opened" if wanted else "none of its images meets the images given"
        raise InputError(f"{earlier.folder}: {where}, so there is nothing to add them to; give its images, too, or "
                         "adjust without --add-to")  # fmt: skip
    loaded = load_views([*images, *(image.spec for image in reached)], **how)
    known = {**{str(file): image.name for file, image in old.items()}, **{image.path: image.name for image in reached}}
    return _renamed(loaded, known, earlier)


def _still_there(images: Sequence[Known], earlier: Earlier) -> list[Known]:
    """Return those of a run's images that are still there, with their places; InputError where one was changed."""
    found, said = list[Known](), "%s: an image of %s is not matched: %s; give its present path, too"
    for image in images:
        try:
            if image.choices is not None:
                found.append(earlier.found(image))
                continue
            why = "its camera came from no file"
        except InputError:
            if os.path.lexists(image.path):
                raise
            why = "no such file any more"
        logger.warning(said, image.path, earlier.folder, why)
    return found


def _needed_images(views: Sequence[View], options: RunOptions, earlier: Earlier) -> list[int]:
    """Return the images of a run that views are matched with, or that matches of theirs are given with."""
    found = set[int]()
    if options.matches:
        names = _new_names([view.path for view in views], earlier), [image.name for image in earlier.images]
        found = {earlier.number[name] for name in linked_names(options.matches, *names)}
    return sorted(found) if options.matches_only else sorted(found.union(earlier.near(views, options.tie)))


def _renamed(loaded: LoadedViews, known: Mapping[str, str], earlier: Earlier) -> LoadedViews:
    """Return views under the names of an earlier run, new ones under others, in the order of these."""
    new = [view.path for view in loaded.views if view.path not in known]
    named = dict(zip(new, _new_names(new, earlier), strict=True)) | dict(known)
    rows = [(replace(v, name=named[v.path]), s) for v, s in zip(loaded.views, loaded.sources, strict=True)]
    rows.sort(key=lambda row: row[0].name)
    return replace(loaded, views=tuple(v for v, _ in rows), sources=tuple(s for _, s in rows))


def _new_names(paths: Sequence[str], earlier: Earlier) -> list[str]:
    """Return names of new images that no image of an earlier run has."""
    taken = [Path(f"/{image.name}.x") for image in earlier.images]
    return unique_names([*map(location, paths), *taken])[: len(paths)]


def chosen_pairs(views: Sequence[View], is_old: Sequence[bool], tie: TieOptions) -> list[tuple[int, int]]:
    """Return the pairs to match: of each new view the best partners, old or new, and those that connect all."""
    pairs = sorted(overlapping_pairs(views, tie), key=lambda pair: (-pair.score, pair.views))
    if not any(is_old[i] != is_old[j] for i, j in (pair.views for pair in pairs)):
        reaches = [reach_of(view, tie.search) for view in views]
        pairs = sorted(overlapping_pairs(views, tie, reaches), key=lambda pair: (-pair.score, pair.views))
    links = [*pairwise(np.flatnonzero(is_old).tolist()), *(pair.views for pair in pairs)]
    tree = {links[k] for k in forests(links, len(views), 1)}
    taken, chosen = [0] * len(views), []
    for pair in pairs:
        own = [i for i in pair.views if not is_old[i]]
        if any(taken[i] < tie.neighbours or pair.views in tree for i in own):
            chosen.append(pair.views)
            for i in own:
                taken[i] += 1
    return sorted(chosen)


def of_new(tracks: Tracks, is_old: BoolArray) -> Tracks:
    """Return the tracks of new views with all their observations.

    The information of old views on these tracks is removed from the prior
    (`barpc.ba.solving.problem.Problem.counted_once`).
    """
    new = ~is_old[tracks.view]
    return tracks.select((np.bincount(tracks.point, new, minlength=tracks.num_points) > 0)[tracks.point])


# --- what the next run needs ------------------------------------------------------------------------------


def images_table(
    run: GrowingRun, given: Sequence[Image], inputs: Mapping[str, Input], folder: Path, block: BlockPrior
) -> str:
    """Return the text of `tables/images.json`: the images of a block, those of an earlier run behind it too."""
    assert run.adjustment is not None
    hosts = run.options.allow_remote
    choices: dict[str, Mapping[str, str] | None] = {}
    for image in given:
        choices[str(image_path(image, hosts))] = None if isinstance(image, View) else split_spec(image, hosts)[1]
    before = {} if run.earlier is None else {image.name: image for image in run.earlier.images}
    rings = footprints(run.cameras, [view.size for view in run.views], run.altitude)[:, ::4]
    rows = {name: _row(image, folder) for name, image in before.items()}
    for view, ring, source in zip(run.views, rings, run.sources, strict=True):
        was, ring = before.get(view.name), np.round(ring, 8)
        of_file = choices.get(view.path, None if was is None else was.choices)
        known, camera = inputs.get(view.path), _sha(inputs, str(source.path))
        outline = tuple((lon, lat) for lon, lat in ring.tolist()) if np.isfinite(ring).all() else ()
        size, sha = (0, "") if known is None else (known.size, known.sha256)
        used = run.calibrated[view.name].sha256 if view.name in run.calibrated else ""
        place = (float(run.altitude), outline)
        rows[view.name] = _row(Known(view.name, view.path, of_file, view.size, *place, size, sha, camera, used), folder)
    text = ",\n".join(json.dumps(rows[name]) for name in block.names)
    return f'{{"images": [\n{text}\n]}}\n'


def _row(image: Known, folder: Path) -> dict[str, Any]:
    choices = image.choices
    if choices is not None and "camera" in choices:
        choices = {**choices, "camera": portable(choices["camera"], folder)}
    return {**vars(image), "path": portable(image.path, folder), "choices": choices}


def added(run: Run, earlier: Earlier, grown: BlockPrior, floor: float) -> Added:
    """Return the effect of a run on the block with its added images: the changes of the block's cameras [px]."""
    moved = earlier.moved(grown)
    ranked = [(earlier.images[i].name, float(moved[i])) for i in np.argsort(-moved, kind="stable")]
    beyond = tuple(one for one in ranked if one[1] > floor)
    met, name = len(run.known), earlier.folder.resolve().name
    updated = run.joint is None
    return Added(name, len(earlier.images), met, beyond, ranked[0], floor, updated, _contradicted(run, floor))


def _contradicted(run: Run, floor: float) -> tuple[str, float, float] | None:
    """Return the image whose check tie points contradict cameras held most, with their RMS held and free [px]."""
    if run.joint is None or run.adjustment is None:
        return None
    held, free = run.adjustment.held_out_rms, run.joint.held_out_rms
    worse = np.where(held > _WORSE * free, held - free, 0.0)
    most = int(np.argmax(np.nan_to_num(worse)))
    return (run.adjustment.names[most], float(held[most]), float(free[most])) if worse[most] > floor else None


def movers(
    run: Run, earlier: Earlier, grown: BlockPrior, done: Collection[str], hosts: Sequence[str]
) -> CorrectedViews:
    """Return the images that move beside those `done`, as `Earlier.corrected` does."""
    assert run.added is not None
    wanted = [earlier.images[earlier.number[name]] for name, _ in run.added.beyond if name not in done]
    there = _still_there(wanted, earlier)
    return earlier.corrected(there, grown, hosts) if there else ([], (), ())
