"""Finished runs in the words of other tools: Sat-NeRF, COLMAP, stereo pipelines, catalogues.

`TARGETS` is the table: a row makes the files of an export, of a `Scene` that was read from the folder of a run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from barpc.base.errors import InputError, OutputError, UsageError
from barpc.base.keywords import PathLike
from barpc.base.manifest import SUMS
from barpc.base.safe_io import plain_path
from barpc.base.verb_options import ExportOptions
from barpc.export.files import FileContents, asp, cars, points, s2p, satnerf, stac
from barpc.export.light import dated
from barpc.export.shots import Scene, read_scene, relative_link
from barpc.workspace import Workspace

__all__ = ["TARGETS", "export_run"]

logger = logging.getLogger(__name__)
_DEFAULTS = ExportOptions()


def _for_trainers(scene: Scene, out: Path, how: ExportOptions) -> FileContents:
    from barpc.export.colmap import colmap  # pinholes, which only this target needs

    return colmap(scene, out, how)


TARGETS: dict[str, Callable[[Scene, Path, ExportOptions], FileContents]] = {
    "satnerf": satnerf,
    "colmap": _for_trainers,
    "s2p": s2p,
    "cars": cars,
    "asp": asp,
    "stac": stac,
    "points": points,
}
"""Tool -> the files made for it, by name, of a scene, the folder where they will lie, and options."""


def export_run(folder: PathLike, target: str, out: PathLike, how: ExportOptions = _DEFAULTS) -> list[Path]:
    """Hand a finished run to another tool, a row of `TARGETS`; return the files written: see `barpc.export`."""
    folder, out = Path(folder), Path(out)
    scene = _checked_scene(folder, target, out, how)
    files = TARGETS[target](scene, out.absolute(), how)
    inputs = [Path(shot.file) for shot in scene.shots if "\0" not in shot.file]
    links = {}
    if how.exact:
        from barpc.export.colmap import image_links

        links = image_links(scene)
    content = {shot.file: one.sha256 for shot in scene.shots if (one := shot.run.inputs.get(shot.entry.path))}
    known = {name: content[image] for name, image in links.items() if image in content}
    with Workspace(out, overwrite=how.overwrite, keep=inputs, names=[*files, SUMS]) as workspace:
        for name, data in files.items():
            with workspace.output(name) as partial:
                partial.write_bytes(data() if callable(data) else data)
        workspace.remove_stale()
        for name, image in links.items():
            _link_image(out / name, relative_link(image, (out / name).parent))
        workspace.seal(scene.run.sealed.root, known)
    return [out / name for name in files]


def _checked_scene(folder: Path, target: str, out: Path, how: ExportOptions) -> Scene:
    if target not in TARGETS:
        raise InputError(f"{target}: no export of that name; there are {', '.join(TARGETS)}")
    if how.alt is not None and not how.alt[0] < how.alt[1]:
        raise InputError(f"altitudes {how.alt}: the lower one first, in metres")
    if target != "colmap" and (how.exact or how.images or how.tolerance is not None):
        raise UsageError(f"--exact, --images and --tolerance go with --to colmap, not {target}")
    plain_path(out.absolute())
    scene = dated(read_scene(folder, how.alt, of_images=target != "points"), how.time, how.date)
    if out.resolve() == folder.resolve():
        raise OutputError(f"{out}: the folder of the run; give the export one of its own")
    return scene


def _link_image(path: Path, image: str) -> None:
    """A link to an image in place of an earlier one; a note in the log where the system makes none."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            path.unlink()
        path.symlink_to(image)
    except FileExistsError:
        raise OutputError(f"{path}: is there already and no link of an earlier export; move it away") from None
    except OSError as error:
        logger.warning("%s: no link to %s (%s): copy the image there", path, image, error.strerror)
