"""Worlds drawn from a family of causes and a seed, and flown, for `worlds.py`, which says what they are for.

python -m benchmarks.worlds --selftest
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.scene import BoolArray, GroundPoints, IntArray, Tracks, View
from barpc.sensor.rpc import RPC
from benchmarks.worlds_cameras import (
    CHIPS,
    Array,
    Camera,
    Flaw,
    Pass,
    Pointing,
    Relief,
    aim,
    beside,
    compass,
    ecef,
    geodetic,
    rpc_of,
)
from benchmarks.worlds_dem import Grid, Wrong, make_dem

NAMES = ("alfa", "bravo", "coca", "delta", "echo", "fox", "golf", "hotel", "india", "julia", "kilo", "lima")
CHECKS, NOISE = 600, 0.1
PRIOR = 7.5  # m: what barpc takes for the accuracy of a camera that states none


# --- drawing a world --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Look:
    """From where a view is taken: incidence along and across the flight, direction of flight and agile scan."""

    pitch: float
    roll: float = 0.0
    heading: float = 192.0
    scan: float | None = None
    speed: float = 1.0


@dataclass(frozen=True)
class Injected:
    """A fault that was put into a world: views, rows or columns (axis 1 or 0, from, to) [px], size [px]."""

    kind: str
    views: tuple[int, ...]
    axis: int
    low: float
    high: float
    size: float
    note: str = ""

    def __str__(self) -> str:
        where = f" {('cols', 'rows')[self.axis]} {self.low:.0f}-{self.high:.0f}" if self.high > self.low else ""
        names = "+".join(NAMES[v] for v in self.views) if len(self.views) < 4 else f"{len(self.views)} views"
        return f"{self.kind} {names}{where} {self.size:.3g} px{' ' if self.note else ''}{self.note}"


@dataclass(frozen=True, eq=False)
class Control:
    """Ground control points, measured to 0.3 px: (G, 3) what is wrong with their places, east, north, up [m]."""

    kind: str
    wrong: Array
    sigma: tuple[float, float, float] = (0.3, 0.3, 0.3)  # as stated [m]
    times: float = 1.0  # as large are the errors of right ones


@dataclass(eq=False)
class Plan:
    """What is drawn, before anything is flown."""

    rng: np.random.Generator
    place: Array
    altitude: float
    gsd: float
    size: tuple[int, int]
    relief: float
    tracks: int
    outliers: float
    looks: list[Look]
    flaws: list[Flaw]
    margins: tuple[float, float]
    injected: list[Injected] = field(default_factory=list)
    deliver: dict[int, Callable[[RPC, Pass, tuple[float, float]], RPC]] = field(default_factory=dict)
    moves: list[Callable[[Array, float], tuple[Array, Array]]] = field(default_factory=list)
    control: Control | None = None
    dem: Wrong | None = None  # what is wrong with the DEM that is given, if one is
    bias: tuple[float, int] | None = None  # px, common to the ties of each of n x n cells of an image
    dates: tuple[int, ...] = ()  # of the views; empty: one date
    shifts: list[Callable[[Array], Array]] = field(default_factory=list)  # of ground from a date to the next [m, ENU]
    tails: float = 0.0  # degrees of freedom of the ties' errors, of Student's distribution; 0: normal

    def flaw(self, view: int, **changed: Any) -> None:
        """Change a view's flaw; a `pointing` is added to those that are there."""
        if "pointing" in changed:
            changed["pointing"] = (*self.flaws[view].pointing, changed["pointing"])
        self.flaws[view] = replace(self.flaws[view], **changed)

    def some(self, low: float, high: float) -> float:
        """A number whose logarithm is uniform."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def direction(self) -> Array:
        """A unit vector in the image."""
        angle = self.rng.uniform(0, 2 * np.pi)
        return np.array([np.cos(angle), np.sin(angle)])


def draw(rng: np.random.Generator, num: int, *, agile: bool = False, side: tuple[int, int] = (8000, 30000)) -> Plan:
    """A world of `num` views without any fault but constant ones."""
    place = np.array([rng.uniform(-170, 170), rng.uniform(-58, 64), rng.uniform(0, 1500)])
    gsd = float(np.exp(rng.uniform(np.log(0.3), np.log(2.0))))
    most = min(side[1], int((28000 if agile else 40000) / gsd))
    size = tuple(int(v) for v in rng.integers(side[0], max(most, side[0] + 1), 2))
    if agile:
        size = (size[0], size[0])
    heading = rng.choice([192.0, 348.0]) + rng.uniform(-4, 4)
    if num > 4:
        flights = [(rng.uniform(-20, 20), heading + rng.uniform(-3, 3)) for _ in range(3)]
        pitches = rng.uniform(-20, 20, num)
        looks = [Look(float(pitches[i]), *flights[i % 3]) for i in range(num)]
    else:
        half, roll = rng.uniform(5, 22), rng.uniform(-22, 22)
        pitches = np.linspace(half, -half, num) + rng.uniform(-1.5, 1.5, num)
        looks = [Look(float(p), roll + rng.uniform(-1, 1), heading) for p in pitches]
    if agile:
        scans = rng.uniform(0, 360, num)
        looks = [replace(k, scan=float(s), speed=rng.uniform(0.8, 1.3)) for k, s in zip(looks, scans, strict=True)]
    flaws = [Flaw(rng.normal(0, 10e-6, 3), rng.normal(0, 2.0, 3)) for _ in range(num)]
    return Plan(
        rng,
        place,
        rng.uniform(450e3, 800e3),
        gsd,
        size,  # type: ignore[arg-type]
        float(np.exp(rng.uniform(np.log(50), np.log(1500)))),
        int(rng.integers(800, 3001)),
        rng.uniform(0.01, 0.03),
        looks,
        flaws,
        (rng.uniform(50, 300), rng.uniform(50, 300)),
    )


def step(low: float, high: float, shift: Array) -> Pointing:
    return lambda row: ((row >= low) & (row < high))[:, None] * shift


def _fade(start: float, rows: float, shift: Array) -> Pointing:
    return lambda row: (row >= start)[:, None] * np.exp(-np.maximum(row - start, 0) / rows)[:, None] * shift


def wave(period: float, phase: float, shift: Array) -> Pointing:
    return lambda row: np.sin(2 * np.pi * row / period + phase)[:, None] * shift


def _walk(rows: int, ends: float, rng: np.random.Generator) -> Pointing:
    """A random walk that is `ends` px off after the scan (one sigma), straight between 300 knots."""
    knots = np.linspace(-0.1, 1.1, 301) * rows
    steps = np.cumsum(rng.normal(0, ends / np.sqrt(300), (301, 2)), axis=0)
    return lambda row: np.stack([np.interp(row, knots, s) for s in steps.T], -1)


def _jump(plan: Plan, view: int) -> None:
    rows = plan.size[1]
    part, size = plan.rng.uniform(0.03, 0.5), plan.some(0.5, 12)
    low = plan.rng.choice([plan.rng.uniform(0, 1 - part), 1 - part, 0.0], p=[0.6, 0.25, 0.15])
    low, high = low * rows, (low + part) * rows
    plan.flaw(
        view,
        pointing=step(low if low > 0 else -np.inf, high if high < rows else np.inf, size * plan.direction()),
    )
    plan.injected.append(Injected("jump", (view,), 1, low, high, size))


def _detector(plan: Plan, view: int) -> None:
    chip, size = int(plan.rng.integers(CHIPS)), plan.some(0.3, 2)
    chips = np.zeros((CHIPS, 2))
    chips[chip] = size * plan.direction()
    plan.flaw(view, chips=chips)
    wide = plan.size[0] / CHIPS
    plan.injected.append(Injected("detector", (view,), 0, chip * wide, (chip + 1) * wide, size))


def _decay(plan: Plan, views: Sequence[int]) -> None:
    size, rows = plan.some(1, 14), plan.rng.uniform(0.02, 0.08) * plan.size[1]
    for view in views:
        plan.flaw(view, pointing=_fade(0.0, rows / 3, size * plan.direction()))
    plan.injected.append(Injected("decay", tuple(views), 1, 0.0, rows, size))


def _cloud(plan: Plan) -> None:
    """A part of the ground, in one piece or scattered, that drifts while the views are taken."""
    rng = plan.rng
    part, size, scattered = rng.uniform(0.15, 0.45), plan.some(0.5, 4), rng.uniform() < 0.35
    rise = rng.uniform(200, 800) if rng.uniform() < 0.4 else 0.0
    waves = rng.normal(0, 9.0 if scattered else 2.2, (8, 2))
    phase, wind = rng.uniform(0, 2 * np.pi, 8), plan.direction()
    plan.margins = plan.margins[0], plan.margins[1] + rise

    def move(uv: Array, gap: float) -> tuple[Array, Array]:
        level = np.cos(uv @ waves.T + phase).sum(axis=1)
        hit = level >= np.quantile(level, 1 - part)
        speed = hit * (1 + 0.1 * np.sin(3 * uv[:, 0] + 2 * uv[:, 1])) * size * plan.gsd / gap
        return speed[:, None] * wind, hit * rise

    plan.moves.append(move)
    kind = "scattered cloud" if scattered else "cloud"
    note = f"a view, {100 * part:.0f} % of ties, {rise:.0f} m up"
    plan.injected.append(Injected(kind, tuple(range(len(plan.looks))), 1, 0, 0, size, note))


def _vehicles(plan: Plan) -> None:
    rng = plan.rng
    part, roads = rng.uniform(0.01, 0.05), rng.uniform(0, np.pi, 3)
    sizes = (2.0, 20.0)

    def move(uv: Array, gap: float) -> tuple[Array, Array]:
        road = roads[rng.integers(0, 3, len(uv))]
        speed = (rng.uniform(size=len(uv)) < part) * rng.uniform(*sizes, len(uv)) * rng.choice([-1, 1], len(uv))
        return (speed * plan.gsd / gap)[:, None] * np.stack([np.cos(road), np.sin(road)], -1), np.zeros(len(uv))

    plan.moves.append(move)
    plan.injected.append(Injected("vehicles", (), 1, 0, 0, sizes[1], f"{100 * part:.1f} % of ties"))


def _strange(plan: Plan, view: int, kind: str) -> None:
    """The RPC of a view is wrong."""
    rng = plan.rng
    look, far = plan.looks[view], plan.some(5, 300) * plan.direction()
    tile, size = plan.some(20, 4000) * plan.direction(), plan.size
    other = Look(
        look.pitch + rng.uniform(-8, 8),
        look.roll + rng.choice([-1, 1]) * rng.uniform(3, 12),
        look.heading + 2,
    )

    slope = float(np.hypot(*np.tan(np.radians([look.pitch, look.roll]))))

    def date(_rpc: RPC, orbit: Pass, alt: tuple[float, float]) -> RPC:
        target = beside(orbit.target, np.array([*far, 0.0]))
        camera = aim(Pass(target, orbit.altitude, other.heading, other.roll), other.pitch, size, plan.gsd)
        return rpc_of(camera, alt)[0]

    def axes(rpc: RPC, _orbit: Pass, _alt: tuple[float, float]) -> RPC:
        coeffs = rpc.coeffs[[2, 3, 0, 1]]
        return replace(rpc, coeffs=coeffs, image_offset=rpc.image_offset[::-1], image_scale=rpc.image_scale[::-1])

    def shifted(rpc: RPC, _orbit: Pass, _alt: tuple[float, float]) -> RPC:
        return replace(rpc, image_offset=rpc.image_offset + tile)

    def datum(rpc: RPC, _orbit: Pass, _alt: tuple[float, float]) -> RPC:
        return replace(rpc, ground_offset=rpc.ground_offset + np.array([0, 0, 50.0]))

    sizes = {
        "date": np.hypot(*far) / plan.gsd,
        "axes": np.nan,
        "tile": np.hypot(*tile),
        "datum": 50.0 * slope / plan.gsd,
    }
    plan.deliver[view] = {"date": date, "axes": axes, "tile": shifted, "datum": datum}[kind]
    note = {"date": f"roll {other.roll - look.roll:+.0f} pitch {other.pitch - look.pitch:+.0f} deg"}.get(kind, "")
    plan.injected.append(Injected(f"foreign {kind}", (view,), 1, 0, 0, float(sizes[kind]), note))


# --- families ---------------------------------------------------------------------------------------------


def _local(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (2, 3, 4, 12)[(seed // 4) % 4])
    num = len(plan.looks)
    first, second = (int(v) for v in rng.permutation(num)[:2])
    kind = seed % 4
    if kind == 0:
        _jump(plan, first)
    elif kind == 1:
        _detector(plan, first)
    elif kind == 2:
        _decay(plan, (first,) if rng.uniform() < 0.5 else range(num))
    else:
        _jump(plan, first)
        (_jump if rng.uniform() < 0.5 else _detector)(plan, second)
    return plan


def _swing(seed: int, rng: np.random.Generator) -> Plan:
    small = seed % 2 == 1
    plan = draw(rng, int(rng.integers(2, 5)), side=(1000, 1001) if small else (8000, 20001))
    if small:
        plan.size, plan.tracks = (1000, 1000), int(rng.integers(300, 2001))
    amplitude, period = plan.some(0.05, 0.3), plan.some(60, 600)
    if seed % 6 == 5:
        amplitude = plan.some(0.005, 0.025)
    view = int(rng.integers(len(plan.looks)))
    plan.flaw(view, pointing=wave(period, rng.uniform(0, 2 * np.pi), amplitude * plan.direction()))
    note = f"period {period:.0f} rows"
    plan.injected.append(Injected("swing", (view,), 1, 0, plan.size[1], amplitude, note))
    return plan


def _clouds(_seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, int(rng.integers(2, 5)))
    _cloud(plan)
    return plan


def _agile(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (2, 3, 3, 4)[seed % 4], agile=seed % 3 != 2)
    drift = rng.uniform(0, 5e-6)
    for view in range(len(plan.looks)):
        plan.flaw(view, drift=rng.normal(0, drift, 3))
    ifov = plan.gsd / plan.altitude
    note = f"{1e6 * drift:.1f} urad, {'steady' if seed % 3 == 2 else 'agile'}"
    plan.injected.append(Injected("drift", tuple(range(len(plan.looks))), 1, 0, 0, drift / ifov, note))
    return plan


def _priors(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (3, 2, 4, 6)[seed % 4])
    factor = (3.0, 6.0)[(seed // 2) % 2]
    for view, look in enumerate(plan.looks):
        metres = plan.altitude / np.cos(np.radians(np.hypot(look.pitch, look.roll)))
        plan.flaw(view, attitude=rng.normal(0, factor * PRIOR / metres, 3), place=rng.normal(0, factor * PRIOR, 3))
    size = factor * PRIOR / plan.gsd
    plan.injected.append(Injected("priors", tuple(range(len(plan.looks))), 1, 0, 0, size, f"{factor:g} times"))
    return plan


def _wander(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, int(rng.integers(2, 5)))
    num, ifov, rows = len(plan.looks), plan.gsd / plan.altitude, plan.size[1]
    views = tuple(range(num)) if rng.uniform() < 0.5 else (int(rng.integers(num)),)
    walk, period = rng.uniform(1e-6, 5e-6), plan.gsd / 6900.0
    kind = ("walk", "settling", "focal", "rate", "all")[seed % 5]
    for view in views:
        if kind in ("walk", "all"):
            plan.flaw(view, pointing=_walk(rows, walk / ifov, rng))
        if kind in ("settling", "all"):
            start = float(rng.uniform(0, 0.8) * rows)
            shift = 20e-6 / ifov * plan.direction()
            plan.flaw(view, pointing=_fade(start, 1.0 / period, shift))
            plan.injected.append(Injected("settling", (view,), 1, start, start, 20e-6 / ifov, f"from row {start:.0f}"))
        if kind in ("focal", "all"):
            plan.flaw(view, focal=rng.choice([-1e-4, 1e-4]))
        if kind in ("rate", "all"):
            plan.flaw(view, rate=rng.choice([-1e-4, 1e-4]))
    sizes = {"walk": walk / ifov, "settling": 20e-6 / ifov, "focal": 5e-5 * plan.size[0], "rate": 5e-5 * rows}
    size = max(sizes.values()) if kind == "all" else sizes[kind]
    if kind != "settling":
        plan.injected.append(Injected(kind, views, 1, 0, 0, size))
    return plan


def _foreign(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, 3 + seed % 4)
    if len(plan.looks) > 4:
        plan.looks = [
            replace(look, pitch=p) for look, p in zip(plan.looks, np.linspace(20, -20, len(plan.looks)), strict=True)
        ]
    kind = ("date", "axes", "tile", "datum")[(seed + seed // 4) % 4]
    if kind == "axes":
        plan.size = (plan.size[0], plan.size[0])
    _strange(plan, int(rng.choice([0, len(plan.looks) - 1])), kind)
    return plan


def _clean(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (2, 3, 4, 6)[(seed // 6) % 4], agile=(seed // 6) % 3 == 2)
    kind = seed % 6
    if kind in (1, 2, 3):
        plan.outliers = (0.1, 0.3, 0.5)[kind - 1]
        plan.injected.append(Injected(f"{100 * plan.outliers:.0f} % outliers", (), 1, 0, 0, 30.0))
    elif kind == 4:
        _vehicles(plan)
    elif kind == 5:
        for view in range(len(plan.looks)):
            size = rng.choice([-1, 1]) * rng.uniform(0.02, 0.05)
            plan.flaw(view, air=size, air_alt=float(plan.place[2]), air_half=plan.relief / 2)
        plan.injected.append(Injected("air", tuple(range(len(plan.looks))), 1, 0, 0, 0.05))
    return plan


def _two(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (3, 4, 3, 2)[seed % 4])
    num = len(plan.looks)
    first, second = (int(v) for v in rng.permutation(num)[:2])
    kind = seed % 6
    if kind in (0, 4):
        (_jump if kind == 0 else _detector)(plan, first)
        _cloud(plan)
    elif kind == 1:
        _detector(plan, first)
        _jump(plan, second)
    elif kind in (2, 5):
        _strange(plan, first, "date" if kind == 2 else "tile")
        (_cloud(plan) if kind == 2 else _decay(plan, (second,)))
    else:
        _decay(plan, range(num))
        _cloud(plan)
    return plan


def _plane(seed: int, rng: np.random.Generator) -> Plan:
    """All detectors of one view off, each by itself, every other time with a swing of its rows."""
    plan = draw(rng, 2 + (seed + 1) % 3)
    view, size = int(rng.integers(len(plan.looks))), plan.some(0.2, 1.2)
    plan.flaw(view, chips=rng.normal(0.0, size, (CHIPS, 2)))
    if seed % 2:
        plan.flaw(view, pointing=wave(plan.some(100, 600), 0.0, plan.some(0.1, 0.3) * plan.direction()))
    plan.injected.append(Injected("detectors", (view,), 0, 0, plan.size[0], size, "and a swing" if seed % 2 else ""))
    return plan


def _biased(_seed: int, rng: np.random.Generator) -> Plan:
    """Matches that err alike in each cell of an image, by half of their own noise to twice of it."""
    plan = draw(rng, int(rng.integers(2, 5)))
    plan.bias = plan.some(0.05, 0.2), int(rng.integers(6, 25))
    plan.injected.append(Injected("bias", (), 1, 0, 0, plan.bias[0], f"{plan.bias[1]} cells a side"))
    return plan


ANGLES = (0.2, 0.5, 0.8, 1.0, 1.1, 1.5, 2.0, 3.0)


def _angles(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, 2)
    roll, angle = rng.uniform(-8, 8), ANGLES[seed % len(ANGLES)]
    plan.looks = [replace(plan.looks[0], pitch=p, roll=roll) for p in (angle / 2, -angle / 2)]
    plan.injected.append(Injected(f"{angle:g} degrees", (0, 1), 1, 0, 0, 0.0))
    return plan


def _wrong(count: int, *groups: Array) -> Array:
    """Errors (count, 3) of points, those of the groups (n, 3) first."""
    given = np.concatenate([np.zeros((0, 3)), *groups])
    return np.concatenate([given, np.zeros((count - len(given), 3))])


def _any(rng: np.random.Generator, count: int, low: float, high: float) -> Array:
    """Errors (count, 3) in any direction, their lengths alike in the logarithm."""
    error = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.5]
    length = np.exp(rng.uniform(np.log(low), np.log(high), count))
    return np.asarray(error / np.linalg.norm(error, axis=1)[:, None] * length[:, None])


_EAST, _UP = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
CONTROL: tuple[tuple[str, Callable[[np.random.Generator], tuple[Array, dict[str, Any]]]], ...] = (
    ("6 clean", lambda _: (_wrong(6), {})),
    ("6 clean, sigmas 3 x too small", lambda _: (_wrong(6), {"times": 3.0})),
    ("1 of 2 wrong by 25 m", lambda rng: (_wrong(2, _any(rng, 1, 25, 25)), {})),
    ("2 of 4 up 40 m", lambda _: (_wrong(4, 40 * _UP, 40 * _UP), {})),
    ("3 of 6 wrong", lambda rng: (_wrong(6, _any(rng, 3, 10, 60)), {})),
    ("1 of 5 30 m east", lambda _: (_wrong(5, 30 * _EAST), {})),
    ("1 of 5 3 m wrong", lambda rng: (_wrong(5, _any(rng, 1, 3, 3)), {})),
    ("12 with 4 of another datum", lambda rng: (_wrong(12, np.repeat(_any(rng, 1, 8, 60), 4, axis=0)), {})),
    ("40 with 10 wrong", lambda rng: (_wrong(40, _any(rng, 10, 3, 100)), {})),
    ("3 and 3", lambda rng: (_wrong(6, np.repeat(_any(rng, 1, 10, 60), 3, axis=0)), {})),
    ("1 point", lambda _: (_wrong(1), {})),
    ("6 in height only", lambda _: (_wrong(6), {"sigma": (1000.0, 1000.0, 0.3)})),
)


def _control(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, (3, 2, 4)[(seed // len(CONTROL)) % 3], side=(8000, 24000))
    kind, make_it = CONTROL[seed % len(CONTROL)]
    wrong, more = make_it(rng)
    plan.control = Control(kind, wrong, **more)
    plan.injected.append(Injected(kind, (), 1, 0, 0, 0.0))
    return plan


WRONG = (
    Wrong("offset", 10.0), Wrong("offset", 40.0), Wrong("tilt", 40.0), Wrong("void", 1000.0),
    Wrong("elsewhere", 9000.0), Wrong("flat"), Wrong("offset", -50.0), Wrong("offset", 300.0),
)  # fmt: skip
"""DEMs that are not as stated."""


def _dem(seed: int, rng: np.random.Generator) -> Plan:
    """Plains of 4 to 19 m, and hills of 190 m, with a DEM as it is stated."""
    plan = draw(rng, 2 + seed % 3, side=(8000, 16000))
    plan.relief = 190.0 if seed % 2 else plan.some(4, 19)
    plan.dem = Wrong()
    plan.injected.append(Injected("dem", (), 1, 0, 0, 0.0, "hills" if seed % 2 else "plains"))
    return plan


def _wrong_dem(seed: int, rng: np.random.Generator) -> Plan:
    plan = draw(rng, 2 + seed % 2, side=(8000, 16000))
    plan.relief = 190.0 if (seed // len(WRONG)) % 2 == 0 else plan.some(4, 19)
    plan.dem = WRONG[seed % len(WRONG)]
    plan.injected.append(Injected(f"dem {plan.dem.kind}", (), 1, 0, 0, 0.0, f"{plan.dem.size:g} m"))
    return plan


DATES = ((0, 0, 1, 1), (0, 0, 1), (0, 1), (0, 0, 0, 1, 1, 1), (0, 1, 0, 1))


def _dated(seed: int, rng: np.random.Generator) -> Plan:
    """Views of two dates, ties with heavy tails and errors that neighbours share."""
    dates = DATES[seed % len(DATES)]
    plan = draw(rng, len(dates), side=(8000, 20000))
    plan.dates, plan.tails = dates, rng.uniform(3, 6)
    plan.bias = plan.some(0.02, 0.06), int(rng.integers(8, 20))
    return plan


def _glacier(seed: int, rng: np.random.Generator) -> Plan:
    """A connected part of the ground that flowed between the dates, slower to its sides; every third one thinned."""
    plan = _dated(seed, rng)
    part, size = rng.uniform(0.1, 0.45), plan.some(0.5, 5)
    axis, start, wind = plan.direction(), rng.uniform(-0.4, 0.4), plan.direction()
    thins = size * rng.uniform(0.3, 1.0) if seed % 3 == 2 else 0.0

    def shift(uv: Array) -> Array:
        off = np.abs(uv @ axis - start + 0.15 * np.sin(3.0 * (uv @ axis[::-1])))
        half = max(float(np.quantile(off, part)), 1e-9)
        flow = np.clip(1.0 - (off / half) ** 4, 0.0, None)  # a plug, as ice flows
        return flow[:, None] * np.append(size * wind, -thins)

    plan.shifts.append(shift)
    note = f"{size:.1f} m on {100 * part:.0f} %{f', {thins:.1f} m thinner' if thins else ''}"
    plan.injected.append(Injected("glacier", tuple(range(len(plan.looks))), 1, 0, 0, size / plan.gsd, note))
    return plan


def _fault(seed: int, rng: np.random.Generator) -> Plan:
    """Ground to one side of a line that moved between the dates; one of both sides is the larger or they are alike."""
    plan = _dated(seed, rng)
    part, size = (0.5, 0.35, 0.2)[seed % 3], plan.some(0.5, 4)
    normal, slip = plan.direction(), np.append(plan.direction(), rng.uniform(-0.3, 0.3)) * size

    def shift(uv: Array) -> Array:
        across = uv @ normal
        return (across > np.quantile(across, 1 - part))[:, None] * slip

    plan.shifts.append(shift)
    note = f"{size:.1f} m on {100 * part:.0f} %"
    plan.injected.append(Injected("fault", tuple(range(len(plan.looks))), 1, 0, 0, size / plan.gsd, note))
    return plan


def _slide(seed: int, rng: np.random.Generator) -> Plan:
    """A landslide: a few per cent of the ground, moved far."""
    plan = _dated(seed, rng)
    part, size, middle = rng.uniform(0.02, 0.08), plan.some(2, 20), rng.uniform(-0.5, 0.5, 2)
    slip = np.append(plan.direction() * size, -0.4 * size)

    def shift(uv: Array) -> Array:
        off = np.linalg.norm(uv - middle, axis=1)
        return (off < np.quantile(off, part))[:, None] * slip

    plan.shifts.append(shift)
    plan.injected.append(Injected("slide", (), 1, 0, 0, size / plan.gsd, f"{size:.1f} m on {100 * part:.0f} %"))
    return plan


def _lost(seed: int, rng: np.random.Generator) -> Plan:
    """Lines that were lost in two views of four: what follows in the image is seen tens of pixels early."""
    plan = draw(rng, 4, side=(8000, 20000))
    plan.tails, plan.bias = rng.uniform(3, 6), (0.03, 12)
    for view in (int(v) for v in rng.permutation(4)[: 1 + seed % 2]):
        size, low = float(rng.integers(4, 60)), rng.uniform(0.15, 0.85) * plan.size[1]
        plan.flaw(view, lost=(low, size))
        plan.injected.append(Injected("jump", (view,), 1, low, plan.size[1], size, "lines lost"))
    return plan


FAMILIES: dict[str, Callable[[int, np.random.Generator], Plan]] = {
    "local": _local,
    "swing": _swing,
    "cloud": _clouds,
    "agile": _agile,
    "priors": _priors,
    "wander": _wander,
    "foreign": _foreign,
    "clean": _clean,
    "two": _two,
    "plane": _plane,
    "biased": _biased,
    "angles": _angles,
    "control": _control,
    "dem": _dem,
    "wrong_dem": _wrong_dem,
    "glacier": _glacier,
    "fault": _fault,
    "slide": _slide,
    "lost": _lost,
}


# --- flying it --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class World:
    """A world made: what barpc is given, and what is true."""

    family: str
    seed: int
    plan: Plan
    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    tracks: Tracks
    bad: BoolArray
    check: Tracks
    ground: Array
    fit: float  # largest error of an RPC against its sound camera [px]
    gcps: GroundPoints | None = None
    dem: Grid | None = None

    def without(self, odd: int) -> World:
        """The same without a view."""
        keep = [v for v in range(len(self.views)) if v != odd]
        number = np.cumsum([v != odd for v in range(len(self.views))]) - 1
        parts = []
        for tracks in (self.tracks, self.check):
            chosen = tracks.select(tracks.view != odd)
            parts.append(Tracks(number[chosen.view], chosen.point, chosen.xy, chosen.sigma))
        held = self.check.view != odd
        seen = np.bincount(self.check.point[held], minlength=len(self.ground)) >= 2
        return replace(
            self,
            cameras=tuple(self.cameras[v] for v in keep),
            views=tuple(self.views[v] for v in keep),
            tracks=parts[0],
            bad=np.zeros(len(parts[0]), dtype=bool),
            check=parts[1],
            ground=self.ground[seen],
        )


def make(family: str, seed: int) -> World:
    """The world of a family and a seed."""
    rng = np.random.default_rng([seed, sum(ord(c) * 31**i for i, c in enumerate(family)) % 2**31])
    return fly(FAMILIES[family](seed, rng), family, seed)


def fly(plan: Plan, family: str = "", seed: int = 0) -> World:
    """A plan carried out."""
    rng = plan.rng
    extent = plan.gsd * max(plan.size)
    relief = Relief.draw(plan.place, plan.relief, extent, rng)
    cameras = []
    for look in plan.looks:
        orbit = Pass(plan.place, plan.altitude, look.heading, look.roll)
        optics = (rng.uniform(-3, 3), rng.uniform(-3, 3))
        cameras.append(aim(orbit, look.pitch, plan.size, plan.gsd, scan=look.scan, speed=look.speed, optics=optics))
    spots = rng.normal(0.0, 5.0, (10, 2)), rng.uniform(0, 2 * np.pi, 10)
    turn = np.radians(plan.looks[0].scan if plan.looks[0].scan is not None else plan.looks[0].heading)

    def scatter(count: int, textured: bool) -> tuple[Array, Array]:
        uv = rng.uniform(-1, 1, (5 * count, 2))
        if textured:
            chance = 0.45 + 0.3 * np.cos(uv @ spots[0].T + spots[1]).sum(axis=1)
            uv = uv[rng.uniform(size=len(uv)) < np.clip(chance, 0.03, 1.0)]
        xy = uv[: 2 * count + 200] * 0.53 * plan.gsd * np.array(plan.size)
        across, along = np.array([-np.cos(turn), np.sin(turn)]), np.array([np.sin(turn), np.cos(turn)])
        return relief.over(xy[:, :1] * across + xy[:, 1:] * along), uv[: len(xy)]

    ground, uv = scatter(plan.tracks, True)
    tracks, bad = _ties(plan, cameras, ground, uv)
    check_ground = scatter(CHECKS, False)[0]
    view, point, xy = _seen(cameras, plan.flaws, [check_ground] * len(cameras), plan.size, CHECKS)
    kept, point = np.unique(point, return_inverse=True)
    check = Tracks(view, point, xy, np.full(len(view), NOISE))
    ground = check_ground[kept]
    alt = float(ground[:, 2].min()) - plan.margins[0], float(ground[:, 2].max()) + plan.margins[1]
    views, worst = [], 0.0
    for v, camera in enumerate(cameras):
        rpc, error = rpc_of(camera, alt)
        worst = max(worst, error)
        if v in plan.deliver:
            rpc = plan.deliver[v](rpc, camera.orbit, alt)
        views.append(View(NAMES[v], f"{NAMES[v]}.tif", plan.size, rpc, alt))
    assert worst < 0.01, f"{family} {seed}: an RPC misses its camera by {worst:.3g} px"
    gcps = None if plan.control is None else _points(plan, cameras, scatter(20 * len(plan.control.wrong), False)[0])
    dem = None if plan.dem is None else make_dem(relief, extent, rng, plan.dem)
    return World(family, seed, plan, tuple(cameras), tuple(views), tracks, bad, check, ground, worst, gcps, dem)


def _points(plan: Plan, cameras: Sequence[Camera], ground: Array) -> GroundPoints:
    """Control points where at least two views see the ground."""
    control, rng = plan.control, plan.rng
    assert control is not None
    count = len(control.wrong)
    view, point, xy = _seen(cameras, plan.flaws, [ground] * len(cameras), plan.size, count)
    kept, point = np.unique(point, return_inverse=True)
    true, sigma = ground[kept], np.array(control.sigma)
    own = rng.normal(size=true.shape) * np.minimum(sigma, 50.0) * control.times
    moved = np.einsum("ni,nij->nj", control.wrong + own, compass(true))
    xy = xy + rng.normal(0, 0.3, xy.shape)
    names, lonlatalt = tuple(f"P{g}" for g in range(count)), geodetic(ecef(true) + moved)
    return GroundPoints(names, lonlatalt, np.tile(sigma, (count, 1)), point, view, xy, np.full(len(view), 0.3))


def _ties(plan: Plan, cameras: Sequence[Camera], ground: Array, uv: Array) -> tuple[Tracks, BoolArray]:
    """Tie points with noise, outliers and what moves; which observations are wrong."""
    rng, num = plan.rng, len(cameras)
    times = np.array([camera.time for camera in cameras])
    gap = max(float(np.mean(np.diff(np.sort(times)))), 0.1)
    grounds, moving = [ground] * num, np.zeros(len(ground), dtype=bool)
    for move in plan.moves:
        speed, rise = move(uv, gap)
        moving |= (speed != 0).any(axis=1)
        for v in range(num):
            enu = np.column_stack([speed * (times[v] - times.mean()), rise])
            place = ecef(grounds[v]) + np.einsum("ni,nij->nj", enu, compass(grounds[v]))
            grounds[v] = geodetic(place)
    for shift in plan.shifts:
        enu = shift(uv)
        moving |= (enu != 0).any(axis=1)
        for v, date in enumerate(plan.dates):
            grounds[v] = geodetic(ecef(grounds[v]) + date * np.einsum("ni,nij->nj", enu, compass(grounds[v])))
    view, point, xy = _seen(cameras, plan.flaws, grounds, plan.size, plan.tracks, rng)
    bad = rng.uniform(size=len(view)) < plan.outliers
    if plan.bias is not None:
        size, side = plan.bias
        cell = (xy / np.array(plan.size) * side).astype(int).clip(0, side - 1)
        xy = xy + rng.normal(0, size, (num, side, side, 2))[view, cell[:, 0], cell[:, 1]]
    noise = rng.normal(0, NOISE, xy.shape)
    if plan.tails:
        noise = 0.6 * NOISE * rng.standard_t(plan.tails, xy.shape)
    xy = xy + noise + bad[:, None] * rng.uniform(-30, 30, xy.shape)
    xy = np.clip(xy, 0.0, np.array(plan.size) - 1.0)  # no matcher finds a point outside its image
    bad |= moving[point]
    point = np.unique(point, return_inverse=True)[1]
    return Tracks(view, point, xy, np.full(len(view), NOISE)), bad


def _seen(
    cameras: Sequence[Camera],
    flaws: Sequence[Flaw],
    grounds: Sequence[Array],
    size: tuple[int, int],
    count: int,
    rng: np.random.Generator | None = None,
) -> tuple[IntArray, IntArray, Array]:
    """View, point and image point of the first `count` points that two views see; with a generator nine in ten do."""
    images = np.stack([c.project(g, f) for c, f, g in zip(cameras, flaws, grounds, strict=True)])
    seen = ((images >= 0) & (images <= np.array(size) - 1)).all(axis=2)
    if rng is not None:
        seen &= rng.uniform(size=seen.shape) < 0.9
    seen &= seen.sum(axis=0) >= 2
    seen[:, np.flatnonzero(seen.any(axis=0))[count:]] = False
    point, view = np.nonzero(seen.T)
    return view, point, images[view, point]


def main() -> None:
    """Say what this is for."""
    argparse.ArgumentParser(description="Worlds for benchmarks/worlds.py, which has the commands.").parse_args()


if __name__ == "__main__":
    main()
