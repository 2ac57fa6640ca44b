"""The reduced normal matrix of an adjusted block, as a prior on its views in a later run.

It contains the information of the old tie points, which are not needed again. A run that adds images has only those
old views that overlap the new images: `BlockPrior.marginal` eliminates the others. `BlockPrior.joined` updates the
matrix of all views with the result of the run, and appends the new views. A block that grows image by image thus gets
the matrix of one joint adjustment, except that parts of it are linearised at earlier states.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.linalg as la

from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.parameters.additional_parameters import OF_VIEWS, AdditionalParameters
from barpc.ba.parameters.priors import CameraPrior, EarlierScene, JointPrior
from barpc.ba.solving.linear import ArrayStore, Blocks, Cholesky, woodbury
from barpc.ba.solving.structure import dissect, unknowns_of
from barpc.base.errors import InputError, plain
from barpc.base.frozen import load_npz
from barpc.base.geodesy import Array
from barpc.base.safe_io import ARRAYS, MAX_NUMBER
from barpc.scene import IntArray

PRIOR_KIND = replace(ARRAYS, words="the prior of an adjusted block")
_SPARSE_ARRAYS = ("diagonal", "pairs", "pair_view")
_OPTIONAL = ("told", "shown", "written")
_SCENE_FIELDS = ("by_unknown", "own", "radius")
_LAYOUT_KEYS = {"steps": "strips"}  # names in files, where they are not those of the fields
_FACTOR_BYTES = 1e8  # bytes of the factor of a whole block to keep in memory; the rest goes to a temporary file


@dataclass(frozen=True, eq=False)
class Rest:
    """The whole block from which a marginal prior was derived, and a function that solves with its matrix."""

    block: BlockPrior  # prior with all views
    index: IntArray  # (m q,) the unknowns of the views that were not eliminated
    solve: Callable[[Array], Array]  # (n q,) or (n q, k) right-hand sides -> solutions with the whole matrix


@dataclass(frozen=True, eq=False)
class BlockPrior:
    """The reduced normal matrix of an adjustment, as a prior on its views.

    Parameters
    ----------
    names : tuple of str
        The n views of the block that were not fixed.
    model, drift : str, int
        Camera model and degree of the drift (see `AdjustOptions`).
    params : (n, q)
        Values of the unknowns.
    information : (n q, n q), array or Blocks
        Joint information on the unknowns (reduced normal matrix), priors included.
    center : (n, 3)
        Camera centres [m], ECEF.
    less : (m, n q)
        B, only with a sparse `information`: the joint information is `information` - B^T B. B stems from common errors
        of heights.
    layout : AdditionalParameters or None
        Layout of the additional parameters in the images; None: there are none.
    scene : EarlierScene or None
        Dependence of the scene's motions on the camera unknowns; None: unknown.
    told : (n,) or None
        Information of the tie points of each view [1/px^2], not limited by the common error of the view.
    shown : (4 + drift, 2) or None
        Sums over corrections, to estimate the camera priors (`barpc.ba.robust.variances.Variances.shown`).
    rest : Rest or None
        The whole block, if this prior is a `marginal`.
    written : (n, q) or None
        Values of the unknowns in the written camera files; None: `params`.
    """

    names: tuple[str, ...]
    model: str
    drift: int
    params: Array
    information: Array | Blocks
    center: Array
    less: Array | None = None
    layout: AdditionalParameters | None = None
    scene: EarlierScene | None = None
    told: Array | None = None
    shown: Array | None = None
    rest: Rest | None = None
    written: Array | None = None

    @property
    def as_written(self) -> Array:
        """Values (n, q) of the unknowns in the written camera files."""
        return self.params if self.written is None else self.written

    def waves(self, names: tuple[str, ...]) -> AdditionalParameters | None:
        """Return the additional parameters for the views `names` of a later run; a new view has only splines."""
        if not self._layout.size:
            return None
        place = {name: i for i, name in enumerate(self.names)}
        return self._layout.select(np.array([place.get(name, -1) for name in names]))

    @property
    def _layout(self) -> AdditionalParameters:
        return AdditionalParameters(0, np.zeros((len(self.names), 0))) if self.layout is None else self.layout

    def save(self, path: Path) -> None:
        """Write the prior to an .npz file."""
        arrays = {name: getattr(self, name) for name in ("params", "center")}
        arrays |= {_LAYOUT_KEYS.get(name, name): one for name, one in self._layout.of_views.items()}
        if isinstance(self.information, np.ndarray):
            arrays["information"] = self.information
        else:
            arrays |= {name: getattr(self.information, name) for name in _SPARSE_ARRAYS}
            arrays["less"] = np.zeros((0, self.params.size)) if self.less is None else self.less
        if self.scene is not None:
            arrays |= {f"scene_{name}": np.asarray(getattr(self.scene, name)) for name in _SCENE_FIELDS}
        arrays |= {name: array for name in _OPTIONAL if (array := getattr(self, name)) is not None}
        with Path(path).open("wb") as file:
            np.savez(  # uncompressed: compression saves a tenth
                file,
                names=np.array(self.names),
                model=self.model,
                drift=self.drift,
                splines=self._layout.count,
                **arrays,
            )

    @classmethod
    def load(cls, path: Path) -> BlockPrior:
        """Load a prior that `save` wrote.

        Raises
        ------
        InputError
            The file is missing or is not such a prior.
        """
        file = load_npz(path, PRIOR_KIND)
        try:
            names = tuple(str(name) for name in file["names"])
            params = file["params"]
            matrix = file["information"] if "information" in file else _read_blocks(file, len(params))
            less = None if "information" in file else file["less"]
            empty = {name: np.zeros((len(names), *shape)) for name, shape in OF_VIEWS.items()}
            of_views = {name: file.get(_LAYOUT_KEYS.get(name, name), none) for name, none in empty.items()}
            layout = AdditionalParameters(int(file.get("splines", 0)), **of_views)
            known = str(file["model"]), int(file["drift"]), params, matrix, file["center"], less
            scene = None
            if "scene_radius" in file:
                by_unknown, own, radius = (file[f"scene_{name}"] for name in _SCENE_FIELDS)
                scene = EarlierScene(by_unknown, own, float(radius))
            learnt = file.get("told"), file.get("shown")
            prior = cls(names, *known, layout, scene, *learnt, written=file.get("written"))
        except (KeyError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError) as error:
            raise InputError(f"{path}: not the prior of an adjusted block ({plain(error)})") from error
        if not prior._is_valid():
            raise InputError(f"{path}: not the prior of an adjusted block (its arrays do not go together)")
        return prior

    def _is_valid(self) -> bool:
        """Return whether all arrays have consistent shapes and valid values."""
        n, q = len(self.names), self.params.shape[-1] if self.params.ndim else 0
        shapes: dict[str, tuple[int, ...]] = {"params": (n, q), "information": (n * q, n * q), "center": (n, 3)}
        arrays = {name: getattr(self, name) for name in shapes}
        if isinstance(self.information, Blocks):
            own = self.information.diagonal
            shapes |= {"information": (n, q, q), "pairs": (len(self.information.pair_view), q, q)}
            arrays |= {"information": own, "pairs": self.information.pairs}
            diagonal = own.diagonal(axis1=1, axis2=2) if own.shape == (n, q, q) else np.zeros(1)
        else:
            diagonal = self.information.diagonal() if self.information.ndim == 2 else np.zeros(1)
        return (
            n * q > 0
            and len(set(self.names)) == n
            and all(arrays[name].shape == shape for name, shape in shapes.items())
            and all(array.dtype == np.float64 for array in arrays.values())
            and all(_is_bounded(array) for array in arrays.values())
            and bool((diagonal > 0).all())
            and self._layout.is_whole(n, q)
            and (self.written is None or (self.written.shape == (n, q) and bool(np.isfinite(self.written).all())))
            and (self.scene is None or _is_whole_scene(self.scene, n * q))
            and (self.told is None or (self.told.shape == (n,) and _is_nonnegative(self.told)))
            and (self.shown is None or (self.shown.shape == (4 + self.drift, 2) and _is_nonnegative(self.shown)))
            and (self.less is None or (self.less.shape[1:] == (n * q,) and _is_bounded(self.less)))
        )

    def dense(self) -> Array:
        """Return the information matrix (n q, n q) as a dense array."""
        if isinstance(self.information, np.ndarray):
            return self.information
        matrix = self.information.plain()
        return matrix if self.less is None else np.asarray(matrix - self.less.T @ self.less)

    def marginal(self, names: Collection[str]) -> BlockPrior:
        """Return the marginal prior on the views among `names`, in the order of this prior: the others are eliminated.

        Raises
        ------
        InputError
            None of the views is in the block, or the matrix is damaged.
        """
        wanted = set(names)
        views = np.array([i for i, name in enumerate(self.names) if name in wanted], dtype=np.int64)
        if not len(views):
            raise InputError("the earlier block has none of these views: nothing is gone on from")
        try:
            rest, information = self._eliminated(views)
        except la.LinAlgError as error:
            raise InputError(f"the earlier block's information is damaged ({plain(error)})") from error
        kept, scene = [self.names[i] for i in views], self.scene
        if scene is not None:
            moves = rest.solve(scene.by_unknown.T)
            by_unknown = moves[rest.index].T @ information
            own = scene.own + scene.by_unknown @ moves - by_unknown @ moves[rest.index]
            scene = EarlierScene(by_unknown, own, scene.radius)
        return replace(
            self,
            names=tuple(kept),
            params=self.params[views],
            information=information,
            center=self.center[views],
            less=None,
            layout=self._layout.select(views),
            scene=scene,
            told=None if self.told is None else self.told[views],
            rest=rest,
            written=None if self.written is None else self.written[views],
        )

    def _eliminated(self, views: IntArray) -> tuple[Rest, Array]:
        """Eliminate all but the views (m,); return the whole block, and the marginal information (m q, m q) on them."""
        n, q = self.params.shape
        blocks = self.information if isinstance(self.information, Blocks) else Blocks.of(self.information, q)
        order = dissect(blocks.pair_view, self.center[:, :2], np.ones(n, dtype=bool), views)
        cholesky = Cholesky(blocks, order, ArrayStore(_FACTOR_BYTES))
        cholesky.factorize(0.0)
        index, information = unknowns_of(views, q), cholesky.last()
        if self.less is None or not len(self.less):
            return Rest(self, index, cholesky.solve), information
        root, _ = woodbury(cholesky.solve, self.less)
        product = information @ root[index]
        information -= product @ np.linalg.solve(np.eye(product.shape[1]) + root[index].T @ product, product.T)
        return Rest(self, index, lambda b: cholesky.solve(b) + root @ (root.T @ b)), information

    def joined(self, later: BlockPrior) -> BlockPrior:
        """Return the prior of the whole block, updated by a later run with some of its views and with new ones.

        Old views outside the later run change with their neighbours, by their covariance with these.

        Parameters
        ----------
        later : BlockPrior
            Prior of the later run. It contains the information of this prior, which is a `marginal`.
        """
        assert self.rest is not None
        whole, q = self.rest.block, self.params.shape[1]
        own = {name: i for i, name in enumerate(self.names)}
        at = np.array([own.get(name, -1) for name in later.names])
        known, new = np.flatnonzero(at >= 0), np.flatnonzero(at < 0)
        # information of the later run beyond its prior
        added = later.dense().copy()
        there, here = unknowns_of(known, q), unknowns_of(at[known], q)
        added[np.ix_(there, there)] -= self.dense()[np.ix_(here, here)]
        change = np.zeros_like(self.params)
        change[at[known]] = later.params[known] - self.params[at[known]]
        pull = np.zeros(whole.params.size)
        pull[self.rest.index] = self.dense() @ change.ravel()
        params = whole.params + self.rest.solve(pull).reshape(whole.params.shape)
        old, count = self.rest.index[::q] // q, len(whole.names)
        params[old[at[known]]] = later.params[known]
        place = np.empty(len(later.names), dtype=np.int64)
        place[known], place[new] = old[at[known]], count + np.arange(len(new))
        scene, num_new = whole.scene, len(new) * q
        if scene is not None:
            scene = replace(scene, by_unknown=np.pad(scene.by_unknown, ((0, 0), (0, num_new))))
        names, told = tuple(later.names[i] for i in new), None
        if whole.told is not None and later.told is not None:
            told = np.concatenate([whole.told, later.told[new]])
        return replace(
            whole,
            names=(*whole.names, *names),
            params=np.concatenate([params, later.params[new]]),
            information=_extended(whole, added, place, len(new)),
            center=np.concatenate([whole.center, later.center[new]]),
            less=np.pad(np.zeros((0, whole.params.size)) if whole.less is None else whole.less, ((0, 0), (0, num_new))),
            layout=whole._layout.joined(later._layout.select(new)),
            scene=scene,
            told=told,
            shown=later.shown,
            written=None,
        )


def _extended(whole: BlockPrior, more: Array, place: IntArray, new: int) -> Blocks:
    """Return the information with `new` views appended, plus `more` (m q, m q) for the views `place` (m,)."""
    q, count = whole.params.shape[1], len(whole.names) + new
    blocks = whole.information if isinstance(whole.information, Blocks) else Blocks.of(whole.information, q)
    of_views = more.reshape(len(place), q, len(place), q)
    every, diagonal = np.arange(len(place)), np.concatenate([blocks.diagonal, np.zeros((new, q, q))])
    diagonal[place] += of_views[every, :, every, :]
    i, j = np.nonzero(place[:, None] < place)
    added, had = place[i] * count + place[j], blocks.pair_view @ [count, 1]
    keys = np.union1d(had, added)
    pairs = np.zeros((len(keys), q, q))
    pairs[np.searchsorted(keys, had)] = blocks.pairs
    pairs[np.searchsorted(keys, added)] += of_views[i, :, j, :]
    return Blocks(diagonal, pairs, np.column_stack([keys // count, keys % count]))


def _is_whole_scene(scene: EarlierScene, size: int) -> bool:
    """Return whether the arrays of a scene are valid for `size` unknowns."""
    arrays, count = (scene.by_unknown, scene.own), len(MOTIONS)
    return (
        tuple(array.shape for array in arrays) == ((count, size), (count, count))
        and all(array.dtype == np.float64 and _is_bounded(array) for array in arrays)
        and 0.0 < scene.radius <= MAX_NUMBER
    )


def _is_bounded(array: Array) -> bool:
    """Return whether all numbers are at most `MAX_NUMBER`, so that their squares are finite."""
    return bool(not array.size or (array.min() >= -MAX_NUMBER and array.max() <= MAX_NUMBER))


def _is_nonnegative(array: Array) -> bool:
    """Return whether all numbers are finite and none is negative."""
    return array.dtype == np.float64 and _is_bounded(array) and bool((array >= 0.0).all())


def _read_blocks(file: Mapping[str, Array], n: int) -> Blocks:
    """Return the sparse matrix of n views in a file that `save` wrote."""
    pairs: IntArray = np.asarray(file["pair_view"])
    blocks = Blocks(file["diagonal"], file["pairs"], pairs)
    if not (pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype == np.int64):
        raise ValueError("its pairs of views are none")
    keys = pairs @ [n, 1]
    if not (_are_indices(pairs.ravel(), n - 1) and (pairs[:, 0] < pairs[:, 1]).all() and (np.diff(keys) > 0).all()):
        raise ValueError("its pairs of views are not in order")
    return blocks


def _are_indices(numbers: Array | IntArray, most: int) -> bool:
    """Return whether all numbers are integers from 0 to `most`."""
    return bool(numbers.ndim == 1 and numbers.dtype.kind in "iu" and ((numbers >= 0) & (numbers <= most)).all())


def apply_prior(
    prior: BlockPrior,
    names: tuple[str, ...],
    model: str,
    drift: int,
    cameras: CameraPrior,
) -> tuple[CameraPrior, JointPrior]:
    """Return the priors of a run that continues an earlier block: a joint prior replaces the priors of the old views.

    Raises
    ------
    InputError
        The earlier block has other unknowns.
    """
    if (prior.model, prior.drift) != (model, drift):
        raise InputError(f"the earlier block was adjusted with {prior.model} (drift {prior.drift}); use the same")
    size = prior.params.shape[1]
    if size != cameras.mean.shape[1]:
        raise InputError(f"the earlier block has {size} unknowns a view, not {cameras.mean.shape[1]}")
    place = {name: i for i, name in enumerate(names)}
    views = np.array([place[name] for name in prior.names])
    mean, sigma = cameras.mean.copy(), cameras.sigma.copy()
    mean[views], sigma[views] = prior.params, np.inf
    index, told = unknowns_of(views, size), np.zeros(len(names))
    told[views] = 0.0 if prior.told is None else prior.told
    return replace(cameras, mean=mean, sigma=sigma), JointPrior(
        index, prior.params.ravel(), prior.dense(), prior.scene, told, prior.shown
    )
