"""Records of the block: its shift, datum shares and weak modes, and the explanations of its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from barpc.base.fields import field_names
from barpc.report.records import Number, Record, column
from barpc.report.summary.words import Count, Vector

AXES = "columns", "rows"
DATUM = (
    "Uncertainty (1 sigma) of the scene's position and shape; shares of the sources that determine it, tie points apart"
)
MODES = {
    "east": "the whole scene may lie {0} farther east or west",
    "north": "the whole scene may lie {0} farther north or south",
    "up": "all heights may be {0} too high or too low",
    "tilt east": "the scene may be tilted: {0} up or down at its eastern and western edges",
    "tilt north": "the scene may be tilted: {0} up or down at its northern and southern edges",
    "turn": "the scene may be turned about the vertical: {0} at its edge",
    "scale": "the scene may be too large or too small: {0} at its edge",
    "twist": "heights may be twisted: by {0} from one corner of the scene to the next",
    "bend east": "heights may be bent: by {0} from the middle of the scene to its eastern and western edges",
    "bend north": "heights may be bent: by {0} from the middle of the scene to its northern and southern edges",
}
"""Motion of the scene (`barpc.ba.constraints.gauge.MOTIONS`) -> its sentence."""
EXPLANATIONS = (
    *("step", "lines_lost", "detector_line", "decay", "transient", "common_edge", "low_frequency"),
    *("sinusoid", "moving_objects", "foreign_camera"),
)
"""Kinds of explanations of residuals: the terms `barpc.ba.terms.TERMS`, and a camera that contradicts the others."""


class ModeEntry(Record):
    """A motion of the scene that the images determine poorly."""

    sigma_m: Number = column("Posterior standard deviation", "m")
    meaning: str = column("The motion", enum=MODES)
    motion_m: tuple[Number, ...] = column(
        "All motions for an error of this one by sigma_m: east, north, up, tilts, turn, scale, twist, bending",
        "m",
        min_length=7,
        max_length=len(MODES),
    )
    words: str = column("Its sentence", min_length=1)


class DatumEntry(Record):
    """Sources of a motion of the scene, as shares of its information. Tie points have none."""

    part: str = column("Motion of the scene", head="motion", enum=MODES)
    sigma_m: Number = column(
        "Posterior standard deviation: of position, or of the shift at the scene's edge",
        "m",
        "sigma",
        ".2f",
    )
    cameras: Number = column("Accuracies of the cameras as delivered", head="delivered cameras", form=".0%")
    earlier_run: Number = column("The earlier run", head="earlier run", form=".0%")
    fixed_views: Number = column("Fixed views", head="fixed views", form=".0%")
    gcps: Number = column("Ground control points", head="GCPs", form=".0%")
    heights: Number = column("The DEM, or altitudes assumed", head="DEM or assumed heights", form=".0%")
    reference: Number = column("A reference orthoimage", head="reference", form=".0%", default=None)
    altimetry: Number = column(
        "Altimetry: heights without image coordinates", head="altimetry", form=".0%", default=None
    )

    @classmethod
    def columns(cls, entries: Sequence[DatumEntry], least: float = 0.005) -> str:
        """Return the columns of a table, without the sources that contribute less to every motion."""
        part, sigma, *sources = field_names(cls)  # type: ignore[arg-type]  # a class can be hashed
        told = [name for name in sources if any((getattr(one, name) or 0.0) >= least for one in entries)]
        return " ".join([part, sigma, *told])


class DemEntry(Record):
    """The constraint by the DEM, and the offset of the tie points from it."""

    num_held: Count = column("Tie points that it constrains")
    num_known: Count = column("Tie points where it has a height")
    num_tracks: Count = column("Tie points in use")
    offset_m: Number = column("Median of the tie points' altitudes minus the DEM's", "m")
    spread_m: Number = column("1.4826 times the median absolute deviation of these", "m")
    sigma_m: Number = column("Standard deviation of single heights, estimated from the tie points", "m", default=None)
    correlated_per_independent: Number = column("Number of correlated heights that count as one", default=None)
    relief: Number = column("The DEM's relief over the tie points'", default=None)


class AltimetryEntry(Record):
    """The constraint by altimetry: heights without image coordinates."""

    num_given: Count = column("Heights in the files")
    num_near: Count = column("Of these, those tested that lie on the surface of the tie points")
    num_agreeing: Count = column("Of these, those that agree on the position of the scene")
    spread_m: Number = column("1.4826 times the median absolute difference of those to the surface", "m")
    expected_m: Number = column("The same as expected from the stated accuracies and the surface", "m")
    motion_enu_m: Vector = column("Shift of the scene by altimetry after the tie points agree", "m")
    sigma_enu_m: Vector = column("Its standard deviation from altimetry alone", "m")
    why_not: str = column("Why they were not used; empty where they constrain the scene")


class JustificationEntry(Record):
    """Residuals of the simpler model, in the image where they are largest, that justified more parameters."""

    image: str = column("View")
    systematic_px: Number = column("RMS of its systematic residuals, noise subtracted", "px")
    systematic_p: Number = column("Probability of as much by noise alone (F test)")
    neighbour_correlated_px: Number = column("Error correlated between neighbouring observations", "px")
    num_images: Count = column("Views with a probability of the F test below 1e-4")


class ExplanationEntry(Record):
    """A selected hypothesis on the residuals of tie points, rejected ones among them."""

    PAGE: ClassVar = "sentence gain gap runner_up"

    name: str = column("Its kind", enum=EXPLANATIONS)
    sentence: str = column("The same as a sentence", head="explanation of residuals", min_length=1)
    image: str | None = column("View; null where it concerns several")
    gain: float = column("Logarithm of its evidence over that of the model without it", "nats", "gain", ".0f")
    gap: float = column("The same over the runner-up", "nats", "over the next", ".0f")
    runner_up: str | None = column("Kind of the runner-up; null for none", head="next", default=None)
    axis: str | None = column("Rows or columns", default=None, enum=AXES)
    first: Number = column("Its first row or column", "px", default=None)
    last: Number = column("Its last row or column", "px", default=None)
    size_px: Number = column("RMS displacement; of a sinusoid its amplitude", "px", default=None)
    period: Number = column("Period of a sinusoid in rows", "px", default=None)
    candidates: tuple[str, ...] | None = column("Other views that explain the tie points as well", default=None)
    share: Number = column("Share of tie points that move together", default=None)
    moved_m: Number = column("Their motion on the ground, apart from an effect of height", "m", default=None)
    between: tuple[str, ...] | None = column("From the first of these views to the second", default=None)
    box: tuple[float, ...] | None = column(
        "West, south, east, north limits of nine in ten of them", "deg", default=None
    )


class LeftEntry(Record):
    """Rows or columns of an image with significantly more rejected tie points, or larger residuals, than the rest."""

    PAGE: ClassVar = "image axis first last rejected off_px rejected_median_px gain"

    image: str = column("View", head="image")
    axis: str = column("Rows or columns", head="axis", enum=AXES)
    first: float = column("The first", "px", "first", ".0f")
    last: float = column("The last", "px", "last", ".0f")
    rejected: float = column("Share of their tie points that were rejected", head="rejected", form=".0%")
    off_px: float = column("Common residual of the others", "px", "common", ".2f")
    rejected_median_px: float = column("Median residual of the rejected ones", "px", "rejected by", ".2f")
    gain: float = column("Logarithm of the likelihood over that of a uniform image", "nats", "gain", ".0f")
    moving: bool = column("Whether the share is of a moving group, not of rejected tie points", default=False)
    moved_px: Number = column("The residual there as a mean over an eighth of the image", "px", default=None)

    @property
    def place(self) -> str:
        """Its rows or columns in words."""
        return f"{self.axis} {self.first:.0f}-{self.last:.0f}"


class HeldOutEntry(Record):
    """Rows, columns or a cell of an image in which check tie points have larger residuals than in the rest."""

    PAGE: ClassVar = "sentence count chance"

    image: str = column("View")
    sentence: str = column("The same as a sentence", head="larger residuals of check tie points", min_length=1)
    columns: tuple[float, float] | None = column("From, to; null for all", "px")
    rows: tuple[float, float] | None = column("From, to; null for all", "px")
    count: Count = column("Observations tested there", head="tested")
    far: float = column("Share of them with the same large residual")
    off_px: float = column("Median of the large residuals; without any the common residual", "px")
    chance: float = column("Probability of as much anywhere by chance, at most", head="p below", form=".0e")
    moved_px: Number = column(
        "The residual there as a mean over an eighth of the image; 0 of a cell", "px", default=None
    )


class UnseenEntry(Record):
    """Rows or columns of an image, displaced behind an edge unseen."""

    image: str = column("View")
    axis: str = column("Their axis, along which they are displaced", enum=AXES)
    largest_px: float = column("The largest, at most 5 rows or 1 column", "px")
    height_m: float = column("Error of heights behind it", "m")


class SceneEntry(Record):
    """The block."""

    shift_enu_m: Vector = column("Mean shift of the tie points, east, north, up", "m")
    sigma_enu_m: Vector = column("Posterior standard deviation of the scene's position", "m")
    radius_m: Number = column(
        "RMS distance of the tie points from their centre: the edge of tilts, turn and scale", "m"
    )
    weakest_modes: tuple[ModeEntry, ...] = column("Poorly determined motions, the weakest first")
    noise: Number = column("Observed over stated standard deviation of the observations")
    drift_degree: Count = column("Degree of the rotation in the row")
    drift_sigma_m: tuple[Number, ...] = column("Its standard deviation at the first and last row, by degree", "m")
    prior_ratio: Number = column("Squared corrections over stated variances and degrees of freedom")
    cost_history: tuple[Number, ...] = column("Sum of squared whitened residuals, by linearisation")
    num_held_in_height: Count = column("Tie points with too small a convergence angle, constrained in height")
    gcp_residuals_enu_m: tuple[Vector, ...] = column("Adjusted minus given position of the GCPs", "m")
    solver: str = column("Termination of the solver")
    prior_shared: Number = column(
        "Factor by which stated accuracies were widened as errors common to all images", default=1.0
    )
    datum: tuple[DatumEntry, ...] = column("Sources of the scene's position and shape", default=())
    dem: DemEntry | None = column("Constraint by the DEM; null without one", default=None)
    altimetry: AltimetryEntry | None = column("Constraint by altimetry; null without any", default=None)
    gcp_scatter: Number = column(
        "RMS residual of the GCPs used over its expectation from their accuracies", default=None
    )
    num_held_out: Count = column("Observations of check tie points, kept out of the adjustment", default=0)
    model: str = column("Unknowns of each view", default="")
    drift_justification: JustificationEntry | None = column(
        "Residuals with a drift of one degree less, where one was added", default=None
    )
    jitter_justification: JustificationEntry | None = column(
        "Residuals without splines and steps, where these were added", default=None
    )
    rigid_model_px: Number = column(
        "RMS of check tie points with a rotation and translation, where an affine was selected", "px", default=None
    )
    explanations: tuple[ExplanationEntry, ...] = column(
        "Hypotheses on residuals in the order of their selection", default=()
    )
    left: tuple[LeftEntry, ...] = column("Rows and columns that are inconsistent with the rest in the end", default=())
    unseen: tuple[UnseenEntry, ...] = column(
        "Displacements of a pair without findings that nothing would have shown", default=()
    )
    held_out_places: tuple[HeldOutEntry, ...] | None = column(
        "Regions with larger residuals of check tie points; null: not tested", default=None
    )
