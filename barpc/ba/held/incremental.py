"""Carrying an adjusted block into the next run: its reduced normal matrix as a prior on its views.

Old tie points are not needed again: everything that they say about the old views is in the matrix. New tie
points may observe old views; an observation that the old block has used must not come back.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from barpc.ba.estimated.priors import CameraPrior, EarlierScene, JointPrior
from barpc.ba.estimated.waves import Waves
from barpc.ba.held.gauge import MOTIONS
from barpc.base.errors import InputError, listed, plain
from barpc.base.frozen import load_npz
from barpc.base.geodesy import Array
from barpc.base.sidefile import ARRAYS, LARGEST

PRIOR = replace(ARRAYS, words="the prior of an adjusted block")
_SPARSE = ("data", "indices", "indptr")
_SCENE = ("by_unknown", "own", "radius")
_LARGEST = 20_000  # unknowns of a block that is gone on from: its matrix is dense then


@dataclass(frozen=True, eq=False)
class BlockPrior:
    """The reduced normal matrix of an adjustment, as a prior on its views.

    Parameters
    ----------
    names : tuple of str
        Views of the block that were free, n of them.
    model, drift : str, int
        The unknowns (see `AdjustOptions`).
    params : (n, q)
        Their values.
    information : (n q, n q), array or csr_array
        Their joint information matrix, priors included.
    center : (n, 3)
        Camera centres [m], ECEF.
    less : (m, n q)
        Rows B of B^T B that is still to be taken off a sparse matrix: what heights have in common.
    splines, edges, strips, periods : int, (n, C), (n, M, 5), (n, M)
        Layout of the unknowns in the image (see `barpc.ba.estimated.waves`).
    radars : tuple of str
        Views of the block whose unknowns are a radar's clocks.
    scene : EarlierScene or None
        Scene of the block, by its cameras' unknowns; None: written by an earlier release.
    """

    names: tuple[str, ...]
    model: str
    drift: int
    params: Array
    information: Array | sp.csr_array
    center: Array
    less: Array | None = None
    splines: int = 0
    edges: Array | None = None
    radars: tuple[str, ...] = ()
    strips: Array | None = None
    periods: Array | None = None
    scene: EarlierScene | None = None

    def waves(self, names: tuple[str, ...]) -> Waves | None:
        """Return the unknowns in the image of the views that go on from the block; a new view has splines alone."""
        of_views = self._edges, self._strips, self._periods
        if self.edges is None or not (self.splines or any(one.size for one in of_views)):
            return None
        place = {name: i for i, name in enumerate(self.names)}
        old = np.array([place.get(name, len(place)) for name in names])
        return Waves(self.splines, *(np.concatenate([x, np.full((1, *x.shape[1:]), np.inf)])[old] for x in of_views))

    @property
    def _edges(self) -> Array:
        return np.zeros((len(self.names), 0)) if self.edges is None else self.edges

    @property
    def _strips(self) -> Array:
        return np.zeros((len(self.names), 0, 5)) if self.strips is None else self.strips

    @property
    def _periods(self) -> Array:
        return np.zeros((len(self.names), 0)) if self.periods is None else self.periods

    def save(self, path: Path) -> None:
        """Write the prior to an .npz file."""
        arrays = {name: getattr(self, name) for name in ("params", "center")}
        if isinstance(self.information, np.ndarray):
            arrays["information"] = self.information
        else:
            arrays |= {name: getattr(self.information, name) for name in _SPARSE}
            arrays["less"] = np.zeros((0, self.params.size)) if self.less is None else self.less
        if self.scene is not None:
            arrays |= {f"scene_{name}": np.asarray(getattr(self.scene, name)) for name in _SCENE}
        with Path(path).open("wb") as file:
            np.savez_compressed(
                file,
                names=np.array(self.names),
                model=self.model,
                drift=self.drift,
                splines=self.splines,
                radars=np.array(self.radars, dtype=np.str_),
                edges=self._edges,
                strips=self._strips,
                periods=self._periods,
                **arrays,
            )

    @classmethod
    def load(cls, path: Path) -> BlockPrior:
        """Load a prior that `save` wrote.

        Raises
        ------
        InputError
            The file is missing or holds something else.
        """
        file = load_npz(path, PRIOR)
        try:
            names = tuple(str(name) for name in file["names"])
            params, sparse = file["params"], "indptr" in file
            matrix = file["information"] if not sparse else _csr(file, params.size)
            less = file["less"] if sparse else None
            splines, edges = int(file.get("splines", 0)), file.get("edges", np.zeros((len(names), 0)))
            known = str(file["model"]), int(file["drift"]), params, matrix, file["center"], less
            radars = tuple(str(name) for name in file.get("radars", ()))
            strips = file.get("strips", np.zeros((len(names), 0, 5)))
            periods = file.get("periods", np.zeros((len(names), 0)))
            scene = None
            if "scene_radius" in file:
                by_unknown, own, radius = (file[f"scene_{name}"] for name in _SCENE)
                scene = EarlierScene(by_unknown, own, float(radius))
            prior = cls(names, *known, splines, edges, radars, strips, periods, scene)
        except (KeyError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as error:
            raise InputError(f"{path}: not the prior of an adjusted block ({plain(error)})") from error
        if not prior._is_whole():
            raise InputError(f"{path}: not the prior of an adjusted block (its arrays do not go together)")
        return prior

    def _is_whole(self) -> bool:
        """Return whether the arrays have the shapes that the names ask for, and hold numbers that a prior can."""
        n, q = len(self.names), self.params.shape[-1] if self.params.ndim else 0
        shapes = {"params": (n, q), "information": (n * q, n * q), "center": (n, 3)}
        arrays = [getattr(self, name) for name in shapes]
        return (
            n * q > 0
            and len(set(self.names)) == n
            and all(array.shape == shape for array, shape in zip(arrays, shapes.values(), strict=True))
            and all(array.dtype == np.float64 for array in arrays)
            and all(_is_plain(array) for array in arrays)
            and bool((self.information.diagonal() > 0).all())
            and self._edges.ndim == 2
            and len(self._edges) == n
            and self._strips.shape[::2] == (n, 5)
            and self._strips.dtype == np.float64
            and self._periods.ndim == 2
            and len(self._periods) == n
            and self._periods.dtype == np.float64
            and bool((self._periods > 0.0).all())
            and (self.splines == 0 or 4 <= self.splines <= q)
            and (self.scene is None or _is_scene(self.scene, n * q))
            and (self.less is None or (self.less.shape[1:] == (n * q,) and _is_plain(self.less)))
        )

    def dense(self) -> Array:
        """Return the information matrix as an array."""
        if isinstance(self.information, np.ndarray):
            return self.information
        if self.params.size > _LARGEST:
            raise InputError(
                f"the earlier block has {len(self.names)} views, too many to go on from: at most "
                f"{_LARGEST // self.params.shape[1]}; adjust all images together"
            )
        matrix: Array = self.information.toarray()
        return matrix if self.less is None else matrix - self.less.T @ self.less


def _is_scene(scene: EarlierScene, size: int) -> bool:
    """Return whether the motions of a scene by so many unknowns are what they can be."""
    arrays, count = (scene.by_unknown, scene.own), len(MOTIONS)
    return (
        tuple(array.shape for array in arrays) == ((count, size), (count, count))
        and all(array.dtype == np.float64 and _is_plain(array) for array in arrays)
        and 0.0 < scene.radius <= LARGEST
    )


def _is_plain(array: Array | sp.csr_array) -> bool:
    """Return whether all numbers are finite, and their squares."""
    numbers = array.data if sp.issparse(array) else array
    return bool((np.abs(np.asarray(numbers)) <= LARGEST).all())


def _csr(file: Mapping[str, Array], size: int) -> sp.csr_array:
    data, indices, bounds = (file[name] for name in _SPARSE)
    # scipy's own check takes differences, which wrap round for numbers at the ends: what it then reads is not its own
    ends = bounds.shape == (size + 1,) and bounds[0] == 0 and bounds[-1] == len(indices) == len(data)
    if not (ends and _within(bounds, len(indices)) and (bounds[1:] >= bounds[:-1]).all()):
        raise ValueError("the bounds of its rows do not go together")
    if not _within(indices, size - 1):
        raise ValueError("a column beyond its size")
    return sp.csr_array((data, indices, bounds), shape=(size, size))


def _within(numbers: Array, most: int) -> bool:
    """Return whether all are whole, and from 0 to `most`."""
    return bool(numbers.ndim == 1 and numbers.dtype.kind in "iu" and ((numbers >= 0) & (numbers <= most)).all())


def apply_prior(
    prior: BlockPrior,
    names: tuple[str, ...],
    model: str,
    drift: int,
    cameras: CameraPrior,
    radars: Collection[str] = (),
) -> tuple[CameraPrior, JointPrior]:
    """Return the priors of a run that goes on from an old block: a joint prior replaces those of the old
    views.

    `radars` are the views whose unknowns are now those of clocks.

    Raises
    ------
    InputError
        The old block's unknowns are others, or one of its views is missing.
    """
    if (prior.model, prior.drift) != (model, drift):
        raise InputError(f"the earlier block was adjusted with {prior.model} (drift {prior.drift}); use the same")
    missing = sorted(set(prior.names) - set(names))
    if missing:
        raise InputError(f"views of the earlier block are missing: {listed(missing)}")
    if other := sorted(set(prior.radars) ^ (set(radars) & set(prior.names))):
        raise InputError(
            f"the earlier block corrected {listed(other)} otherwise, as a radar or not as one: give the same "
            "camera files, or adjust all images together"
        )
    size = prior.params.shape[1]
    if size != cameras.mean.shape[1]:
        raise InputError(f"the earlier block has {size} unknowns a view, not {cameras.mean.shape[1]}")
    try:
        root = la.cholesky(prior.dense())
    except la.LinAlgError as error:
        raise InputError(f"the earlier block's information is damaged ({plain(error)})") from error
    place = {name: i for i, name in enumerate(names)}
    views = np.array([place[name] for name in prior.names])
    mean, sigma = cameras.mean.copy(), cameras.sigma.copy()
    mean[views], sigma[views] = prior.params, np.inf
    index = (views[:, None] * size + np.arange(size)).ravel()
    return replace(cameras, mean=mean, sigma=sigma), JointPrior(index, prior.params.ravel(), root, prior.scene)
