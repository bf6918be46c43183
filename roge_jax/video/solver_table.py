"""Fixed-step samplers written as tables.

Every fixed-step method here is a list of velocity evaluations; between two of them the few vectors
it remembers are mixed linearly, with numbers that depend on the grid alone. So a method is written
below as ordinary arithmetic on *symbolic* vectors, executed once on the host in float64, and
lowered to a table: noise level and mixing matrix of each evaluation. `solvers.solve` runs any table
with one scan whose body holds the network once, whatever the method and however many stages.

Last step. No table evaluates the field at sigma = 0, where exact velocities are 0/0 and networks
were never trained. Methods that would (Heun, RK4) close with a lower-stage method of the same local
order that stays inside: Heun with one Euler step, RK4 with Heun's third-order method.

Breaks. Where the field jumps (guidance switching), a stage that falls on the break is evaluated just
inside its own step, and methods with a memory start again.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from flax import struct

from roge_jax.errors import UserError, did_you_mean


class Vector:
    """A linear combination of stored vectors: {number of the vector: coefficient}."""

    __slots__ = ("terms",)

    def __init__(self, terms: dict[int, float]):
        self.terms = {k: c for k, c in terms.items() if c != 0.0}

    def __add__(self, other: "Vector") -> "Vector":
        keys = self.terms.keys() | other.terms.keys()
        return Vector({k: self.terms.get(k, 0.0) + other.terms.get(k, 0.0) for k in keys})

    def __mul__(self, scale: float) -> "Vector":
        return Vector({k: c * float(scale) for k, c in self.terms.items()})

    __rmul__ = __mul__

    def __sub__(self, other: "Vector") -> "Vector":
        return self + (-1.0) * other


@dataclass(frozen=True)
class Step:
    """One interval of the grid, s0 -> s1 < s0. `fresh`: nothing before s0 may be remembered."""

    index: int
    s0: float
    s1: float
    fresh: bool
    break_at_end: bool
    last: bool  # ends at sigma = 0

    @property
    def h(self) -> float:
        """Length of the step, negative: sigma falls."""
        return self.s1 - self.s0


class Tape:
    """Records what a method evaluates and keeps; vector 0 is the start state."""

    def __init__(self, steps: list[Step], evaluate_at: np.ndarray | None):
        self.steps, self.evaluate_at = steps, evaluate_at
        self.ops: list[tuple[str, Vector]] = []
        self.sigma: list[float] = []
        self.side: list[int] = []
        self.step: list[int] = []

    def __iter__(self) -> Iterator[Step]:
        return iter(self.steps)

    def keep(self, x: Vector) -> Vector:
        """Store `x` as a vector of its own, so that what it was made of can be forgotten."""
        self.ops.append(("keep", x))
        return Vector({len(self.ops): 1.0})

    def velocity(self, x: Vector, step: Step, c: float = 0.0) -> Vector:
        """Evaluate the field on `x` at fraction `c` of the step."""
        sigma = step.s0 + c * step.h
        if c == 0.0 and self.evaluate_at is not None:
            sigma = float(self.evaluate_at[step.index])
        assert sigma > 0.0, "a table must not evaluate the field at sigma = 0"
        at_break = (c == 0.0 and step.fresh and step.index > 0) or (c == 1.0 and step.break_at_end)
        self.side.append((1 if c == 1.0 else -1) if at_break else 0)
        self.sigma.append(sigma)
        self.step.append(step.index)
        self.ops.append(("velocity", x))
        return Vector({len(self.ops): 1.0})


# ---- the methods: (tape, start) -> end ----------------------------------------------------------


def _euler(tape: Tape, x: Vector) -> Vector:
    for step in tape:
        x = tape.keep(x + step.h * tape.velocity(x, step))
    return x


def _midpoint(tape: Tape, x: Vector) -> Vector:
    for step in tape:
        half = x + 0.5 * step.h * tape.velocity(x, step)
        x = tape.keep(x + step.h * tape.velocity(half, step, 0.5))
    return x


def _heun(tape: Tape, x: Vector) -> Vector:
    for step in tape:
        v0 = tape.velocity(x, step)
        euler = tape.keep(x + step.h * v0)
        if step.last:  # the corrector would look at sigma = 0
            x = euler
        else:
            x = tape.keep(x + 0.5 * step.h * (v0 + tape.velocity(euler, step, 1.0)))
    return x


def _rk4(tape: Tape, x: Vector) -> Vector:
    for step in tape:
        h = step.h
        v = tape.velocity(x, step)
        if step.last:  # Heun's third order: nodes 0, 1/3, 2/3 stay inside
            total = tape.keep(x + h / 4 * v)
            v = tape.velocity(x + h / 3 * v, step, 1 / 3)
            x = tape.keep(total + 3 * h / 4 * tape.velocity(x + 2 * h / 3 * v, step, 2 / 3))
            continue
        total = tape.keep(x + h / 6 * v)
        v = tape.velocity(x + h / 2 * v, step, 0.5)
        total = tape.keep(total + h / 3 * v)
        v = tape.velocity(x + h / 2 * v, step, 0.5)
        total = tape.keep(total + h / 3 * v)
        x = tape.keep(total + h / 6 * tape.velocity(x + h * v, step, 1.0))
    return x


def _adams_bashforth(order: int) -> Callable[[Tape, Vector], Vector]:
    def method(tape: Tape, x: Vector) -> Vector:
        past: list[tuple[float, Vector]] = []
        for step in tape:
            past = [] if step.fresh else past
            v = tape.velocity(x, step)
            past = [(step.s0, v), *past][:order]
            if order == 3 and len(past) == 1:  # Euler's start would cap the order at 2
                half = x + 0.5 * step.h * v
                x = tape.keep(x + step.h * tape.velocity(half, step, 0.5))
                continue
            # weights w with sum_j w_j (s_j - s0)^k = h^(k+1) / (k+1): exact for polynomials
            nodes = np.array([s - step.s0 for s, _ in past]) / step.h
            powers = np.arange(len(past))
            weights = np.linalg.solve(nodes[None] ** powers[:, None], 1.0 / (powers + 1.0))
            for w, (_, slope) in zip(weights, past, strict=True):
                x = x + step.h * w * slope
            x = tape.keep(x)
        return x

    return method


def _log_snr(sigma: float) -> float:
    """lambda = log((1 - sigma) / sigma); infinite at the ends."""
    with np.errstate(divide="ignore"):
        return float(np.log1p(-sigma) - np.log(sigma))


def _dpmpp_2m(tape: Tape, x: Vector) -> Vector:
    """DPM-Solver++(2M) in flow form; alpha1 expm1(-h) of the papers is (s1 - s0) / s0 here."""
    before: tuple[float, Vector] | None = None  # (lambda, x0 estimate) of the step before
    for step in tape:
        lam0 = _log_snr(step.s0)
        clean = tape.keep(x - step.s0 * tape.velocity(x, step))
        x = (step.s1 / step.s0) * x - (step.h / step.s0) * clean
        if before is not None and not step.fresh and not step.last:
            # the last step is first order (its h is infinite), as in the official sampler
            ratio = (_log_snr(step.s1) - lam0) / (lam0 - before[0])  # h / h_before; 0 after sigma=1
            x = x - (0.5 * ratio * step.h / step.s0) * (clean - before[1])
        x = tape.keep(x)
        before = (lam0, clean)
    return x


def _unipc_2(tape: Tape, x: Vector) -> Vector:
    """UniPC of order 2 (variant bh2, predicting x0), Wan's default sampler."""
    past: list[tuple[float, Vector]] = []  # (lambda, x0 estimate), newest first
    previous: tuple[Step, Vector, bool] | None = None  # step before, its corrected start, two-term
    for step in tape:
        lam0 = _log_snr(step.s0)
        clean = tape.keep(x - step.s0 * tape.velocity(x, step))
        if previous is not None and not step.fresh:
            x = tape.keep(_unipc_correct(*previous, past, clean, lam0))
        past = [] if step.fresh else past
        past = [(lam0, clean), *past][:2]
        two = len(past) == 2 and not step.last
        ahead = (step.s1 / step.s0) * x - (step.h / step.s0) * clean
        if two:
            r = (past[1][0] - lam0) / (_log_snr(step.s1) - lam0)
            ahead = ahead - (0.5 / r * step.h / step.s0) * (past[1][1] - clean)
        previous = (step, x, two)
        x = tape.keep(ahead)
    return x


def _unipc_correct(
    step: Step, x: Vector, two: bool, past: list[tuple[float, Vector]], clean: Vector, lam: float
) -> Vector:
    """Redo `step` from its start `x`, now that the x0 estimate `clean` at its end is known."""
    (lam0, old), scale = past[0], step.h / step.s0
    base = (step.s1 / step.s0) * x - scale * old
    h = lam - lam0
    if not two or not np.isfinite(h):
        return base - 0.5 * scale * (clean - old)
    b0 = np.expm1(-h)
    phi1 = b0 / -h - 1.0
    phi2 = phi1 / -h - 0.5
    b1, b2 = phi1 / b0, 2.0 * phi2 / b0
    r = (past[1][0] - lam0) / h
    if np.isinf(r):  # the older estimate sits at sigma = 1, infinitely far in lambda
        return base - b1 * scale * (clean - old)
    rho1 = (b2 - r * b1) / (1.0 - r)
    return base - scale * (((b1 - rho1) / r) * (past[1][1] - old) + rho1 * (clean - old))


def _rkc2(tape: Tape, x: Vector, stages: int = 4) -> Vector:
    """Runge-Kutta-Chebyshev, order 2 (Sommeijer, Shampine and Verwer 1997, eqs. 2.2 to 2.7).

    `stages` evaluations buy a real stability interval of about 0.65 stages^2: 10 for 4 stages, 41
    for 8, where as many Euler steps have 8 and 16. None of them looks at the end of the step.
    """
    w0 = 1.0 + (2.0 / 13.0) / stages**2
    poly = [np.polynomial.Chebyshev.basis(j) for j in range(stages + 1)]
    t, dt, ddt = (np.array([p.deriv(k)(w0) if k else p(w0) for p in poly]) for k in range(3))
    w1 = dt[-1] / ddt[-1]
    b = np.concatenate([[0.0, 0.0], ddt[2:] / dt[2:] ** 2])
    b[:2] = b[2]
    c = np.concatenate([[0.0, 0.0], w1 * ddt[2:] / dt[2:]])
    c[1] = c[2] / dt[2]
    for step in tape:
        h, start = step.h, x
        v0 = tape.velocity(start, step)
        older, y = start, tape.keep(start + b[1] * w1 * h * v0)
        for j in range(2, stages + 1):
            mu, nu, mu_v = 2 * b[j] * w0 / b[j - 1], -b[j] / b[j - 2], 2 * b[j] * w1 / b[j - 1]
            gamma_v = -(1.0 - b[j - 1] * t[j - 1]) * mu_v
            new = (1 - mu - nu) * start + mu * y + nu * older + gamma_v * h * v0
            new = new + mu_v * h * tape.velocity(y, step, float(c[j - 1]))
            older, y = y, tape.keep(new)
        x = y
    return x


@dataclass(frozen=True)
class Solver:
    """What is known of a sampler: its order and what a step costs (the chart's x axis)."""

    order: int
    nfe_per_step: int  # the first and last step may differ: `nfe` counts exactly
    method: Callable[[Tape, Vector], Vector] | None  # None: adaptive, see adaptive.py
    summary: str


SOLVERS: dict[str, Solver] = {
    "euler": Solver(1, 1, _euler, "one slope a step; never unstable here, smooths fine detail"),
    "midpoint": Solver(2, 2, _midpoint, "two stages, none at the end of the step"),
    "heun": Solver(2, 2, _heun, "trapezium; closes with an Euler step"),
    "rk4": Solver(4, 4, _rk4, "classical; closes with Heun's third-order method"),
    "ab2": Solver(2, 1, _adams_bashforth(2), "Adams-Bashforth on the grid as it is"),
    "ab3": Solver(3, 1, _adams_bashforth(3), "Adams-Bashforth, started by one midpoint step"),
    "dpmpp_2m": Solver(2, 1, _dpmpp_2m, "DPM-Solver++(2M), flow form"),
    "unipc_2": Solver(2, 1, _unipc_2, "UniPC order 2, flow form: Wan's default"),
    "rkc2": Solver(2, 4, _rkc2, "stabilised Runge-Kutta-Chebyshev, stable to 10"),
    "rkc2_8": Solver(2, 8, partial(_rkc2, stages=8), "the same with 8 stages, stable to 41"),
    "bosh3": Solver(3, 3, None, "adaptive Bogacki-Shampine 3(2), PI step control"),
}


# ---- lowering -----------------------------------------------------------------------------------


@struct.dataclass
class Table:
    """A solver on a grid, ready to run; E evaluations, R stored vectors, n steps.

    An argument of the compiled sampler: grids of one length share one compilation.
    """

    sigma: np.ndarray  # [E] noise level of each evaluation, never 0
    side: np.ndarray  # [E] -1 / +1: evaluate just below / above this level (a break), else 0
    step: np.ndarray  # [E] step an evaluation belongs to
    begin: np.ndarray  # [R] stored vectors before the first evaluation, in units of x1
    mix: np.ndarray  # [E, R, R + 1] stored vectors after, from the stored ones and the velocity
    first: np.ndarray  # [n] the evaluation that opens each step
    grid: np.ndarray  # [n + 1] noise levels


def tabulate(
    name: str,
    sigmas: np.ndarray,
    *,
    breaks: Sequence[float] = (),
    evaluate_at: np.ndarray | None = None,
) -> Table:
    """Write solver `name` on the descending grid `sigmas` [n + 1] as a Table.

    `breaks`: noise levels where the field jumps; those inside the grid must be grid points.
    `evaluate_at` [n]: noise level told to the field at the start of each step, where it differs
    from the grid's (Wan's own samplers truncate the timestep to a whole number).
    """
    method = _solver(name).method
    if method is None:
        raise UserError(f"Solver '{name}' chooses its own steps and has no table; use solve().")
    sigmas = check_grid(sigmas, breaks)
    jumps = np.isin(sigmas.astype(np.float32), np.asarray(breaks, np.float32))
    n = len(sigmas) - 1
    steps = [
        Step(
            index=i,
            s0=float(sigmas[i]),
            s1=float(sigmas[i + 1]),
            fresh=i == 0 or bool(jumps[i]),
            break_at_end=bool(jumps[i + 1]),
            last=bool(sigmas[i + 1] == 0.0),
        )
        for i in range(n)
    ]
    tape = Tape(steps, evaluate_at)
    end = method(tape, Vector({0: 1.0}))
    begin, mix = _lower(tape, end)
    step = np.asarray(tape.step, np.int32)
    return Table(
        sigma=np.asarray(tape.sigma),
        side=np.asarray(tape.side, np.int32),
        step=step,
        begin=begin,
        mix=mix,
        first=np.searchsorted(step, np.arange(n)).astype(np.int32),
        grid=sigmas,
    )


def _lower(tape: Tape, end: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Turn the record into `begin` [R] and `mix` [E, R, R + 1] (see Table)."""
    ops = [*tape.ops, ("end", end)]
    last_use = {k: i for i, (_, x) in enumerate(ops) for k in x.terms}
    # `known` writes each vector still of use in terms of the slots of the moment
    known: dict[int, dict[int, float]] = {0: {0: 1.0}}
    layouts: list[list[dict[int, float]]] = []

    def expand(x: Vector) -> dict[int, float]:
        total: dict[int, float] = {}
        for k, c in x.terms.items():
            for slot, value in known[k].items():
                total[slot] = total.get(slot, 0.0) + c * value
        return total

    for i, (kind, x) in enumerate(ops):
        if kind == "keep":
            known[i + 1] = expand(x)
            continue
        rows = [expand(x)]  # slot 0 is what the field is evaluated on, and at the end the result
        after: dict[int, dict[int, float]] = {}
        for k, terms in known.items():
            if last_use.get(k, -1) > i:
                slot = rows.index(terms) if terms in rows else len(rows)
                if slot == len(rows):
                    rows.append(terms)
                after[k] = {slot: 1.0}
        layouts.append(rows)
        known = {**after, i + 1: {-1: 1.0}}  # slot -1: the velocity just computed
    width = max(len(rows) for rows in layouts)
    begin = np.zeros(width)
    for r, terms in enumerate(layouts[0]):
        begin[r] = terms.get(0, 0.0)
    mix = np.zeros((len(layouts) - 1, width, width + 1))
    for e, rows in enumerate(layouts[1:]):
        for r, terms in enumerate(rows):
            for slot, value in terms.items():
                mix[e, r, slot] = value  # slot -1 is the last column, the velocity
    return begin, mix


def check_grid(sigmas: np.ndarray, breaks: Sequence[float] = ()) -> np.ndarray:
    """The grid as float64 if it descends strictly within [0, 1] and holds every break inside it."""
    sigmas = np.asarray(sigmas, np.float64)
    if sigmas.ndim != 1 or len(sigmas) < 2:
        raise UserError(
            f"A sigma grid has shape {sigmas.shape}; give [steps + 1] numbers, 2 or more."
        )
    if not np.isfinite(sigmas).all() or sigmas.max() > 1 or sigmas.min() < 0:
        raise UserError(f"A sigma grid must be finite and lie in [0, 1]; given {sigmas}.")
    bad = np.flatnonzero(np.diff(sigmas.astype(np.float32)) >= 0)  # float32: what the sampler sees
    if len(bad):
        i = int(bad[0])
        raise UserError(
            f"A sigma grid must descend strictly, but entries {i} and {i + 1} are {sigmas[i]:.9g} and "
            f"{sigmas[i + 1]:.9g}; remove repeated values and sort from 1 to 0."
        )
    for b in breaks:
        if sigmas[-1] < b < sigmas[0] and np.float32(b) not in sigmas.astype(np.float32):
            raise UserError(
                f"The field switches at sigma {b}, which is not a grid point; make the grid with "
                f"schedule(..., breaks=({b},)) or with_breaks(grid, ({b},))."
            )
    return sigmas


def nfe(name: str, steps: int) -> int:
    """Velocity evaluations of `steps` steps on a grid that ends at 0, without breaks."""
    return len(tabulate(name, np.linspace(1.0, 0.0, steps + 1)).sigma)


def _solver(name: str) -> Solver:
    if name not in SOLVERS:
        raise UserError(f"Unknown solver '{name}'; {did_you_mean(name, SOLVERS)}")
    return SOLVERS[name]
