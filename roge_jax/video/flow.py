"""The flow between photos and noise: path, training noise levels, and the grids samplers walk on.

sigma in [0, 1] is the noise level, 1 = pure noise. Path and target (rectified flow):

    x_sigma = (1 - sigma) x0 + sigma noise,      velocity = dx/dsigma = noise - x0.

Sampling integrates dx/dsigma = v(x, sigma) from sigma = 1 down to 0 (`solvers.py`). Networks of
the Wan family read the noise level as a *timestep* = 1000 sigma. Grids are float64 NumPy arrays,
made on the host, so that they are checked before anything is compiled.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from roge_jax.errors import UserError, did_you_mean

TRAIN_POINTS = 1000
SCHEDULES = ("shift", "unipc", "dpmpp", "uniform", "graded", "optimised")
ContextSlots = Literal["noised", "clean", "free"]
WEIGHTS = ("bump", "uniform")
SIGMA_SAMPLERS = ("uniform_index", "logit_normal")
OPTIMISED_FILE = Path(__file__).with_name("schedules.json")


# ---- path -----------------------------------------------------------------------------------


def _per_sample(sigma: Array, x: Array) -> Array:
    """`sigma` [...] with trailing axes of length 1 so that it multiplies `x` [..., *rest]."""
    sigma = jnp.asarray(sigma)
    return sigma.reshape(sigma.shape + (1,) * (x.ndim - sigma.ndim))


def x_sigma(x0: Array, noise: Array, sigma: Array) -> Array:
    """The noised sample (1 - sigma) x0 + sigma noise; sigma is a scalar or has x0's leading axes."""
    s = _per_sample(sigma, x0)
    return (1 - s) * x0 + s * noise


def velocity_target(x0: Array, noise: Array) -> Array:
    """What the network learns: d x_sigma / d sigma = noise - x0."""
    return noise - x0


def denoised(x: Array, velocity: Array, sigma: Array) -> Array:
    """The clean sample implied by a velocity: x0 = x - sigma v."""
    return x - _per_sample(sigma, x) * velocity


def velocity_about(guess: Array, spread: Array, x: Array, sigma: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of noise - x0 at x = x_sigma if x0 is normal about `guess` with deviation `spread`.

    The line through two jointly normal variables: with y = x - (1 - sigma) guess and
    d = (1 - sigma)^2 spread^2 + sigma^2,

        mean = (sigma - (1 - sigma) spread^2) / d  y - guess,      deviation = spread / sqrt(d),

    which is x - guess and spread at sigma = 1, and -x and 1 at sigma = 0. `guess` and x are [.., c], `spread` [c] is
    above 0; sigma is a scalar or has the leading axes of x.
    """
    s, spread = _per_sample(sigma, x), jnp.reshape(spread, (1,) * (x.ndim - 1) + (-1,))
    variance = jnp.square(spread)
    total = jnp.square(1 - s) * variance + jnp.square(s)
    mean = (s - (1 - s) * variance) / total * (x - (1 - s) * guess) - guess
    return mean, jnp.broadcast_to(spread / jnp.sqrt(total), x.shape)


def context_projection(x0: Array, noise: Array, mode: ContextSlots) -> Callable | None:
    """What happens to the context slots before the network looks: noised to sigma (as in training), clean, or free."""
    m = x0.shape[0]
    if mode == "free":
        return None

    def project(x, sigma):
        known = x_sigma(x0, noise[:m], sigma) if mode == "noised" else x0
        return jnp.concatenate([known, x[m:]])

    return project


def shifted(u, shift: float):
    """Wan's schedule shift: u -> shift u / (1 + (shift - 1) u); 1 leaves u as it is."""
    return shift * u / (1 + (shift - 1) * u)


def timesteps(sigmas, *, truncate: bool = False) -> np.ndarray:
    """The numbers the network reads: 1000 sigma. `truncate` drops the fraction, as Wan's code does."""
    times = 1000.0 * np.asarray(sigmas, np.float64)
    return np.floor(times) if truncate else times


# ---- training ----------------------------------------------------------------------------------


def training_table(shift: float = 5.0, weighting: str = "bump") -> tuple[np.ndarray, np.ndarray]:
    """The training grid and its loss weights, both float64 [1000], sigma from 1 downwards.

    sigma_i = shifted(1 - i / 1000); the bump weights have mean 1 over the grid (DiffSynth-Studio's
    training scheduler, which FrameCrafter and RoGe inherit).
    """
    _known(weighting, WEIGHTS, "loss weighting")
    sigmas = shifted(1.0 - np.arange(TRAIN_POINTS) / TRAIN_POINTS, shift)
    if weighting == "uniform":
        return sigmas, np.ones(TRAIN_POINTS)
    bump = _bump(sigmas)
    return sigmas, bump * TRAIN_POINTS / bump.sum()


def _bump(sigma: np.ndarray) -> np.ndarray:
    """Gaussian bump at sigma = 0.5 less its end value: exactly 0 at sigma = 1 (and at 0)."""
    return np.exp(-2.0 * (sigma - 0.5) ** 2) - np.exp(-0.5)


def loss_weight(sigma: Array, *, weighting: str = "bump", shift: float = 5.0) -> Array:
    """w(sigma) of the training loss, any shape; mean 1 over the training grid of this shift.

    "bump" is largest (2.08) near sigma = 0.5 and exactly 0 at sigma = 1; "uniform" is 1.
    """
    _known(weighting, WEIGHTS, "loss weighting")
    sigma = jnp.asarray(sigma, jnp.float32)
    if weighting == "uniform":
        return jnp.ones_like(sigma)
    total = float(np.sum(_bump(training_table(shift, "uniform")[0])))
    bump = jnp.exp(-2.0 * (sigma - 0.5) ** 2) - float(np.exp(-0.5))
    return jnp.maximum(bump, 0.0) * (TRAIN_POINTS / total)


class Noised(NamedTuple):
    """Latents of all slots [t, lh, lw, c] at a noise level, and what the network makes of them."""

    sigma: Array  # []
    noise: Array
    x_sigma: Array  # what the network saw
    velocity: Array  # what it said
    predicted_x0: Array  # the clean latents that this implies


def error(
    noised: Noised, x0: Array, *, contexts: int, weighting: str = "bump", shift: float = 5.0
) -> Array:
    """w(sigma) |V - (noise - x0)|^2, the mean over target latents: those after the first `contexts` slots."""
    off = (noised.velocity - velocity_target(x0, noised.noise))[contexts:]
    return loss_weight(noised.sigma, weighting=weighting, shift=shift) * jnp.square(off).mean()


def training_sigma(
    key: Array,
    shape: tuple[int, ...] = (),
    *,
    method: str = "uniform_index",
    shift: float = 5.0,
    mean: float = 0.0,
    std: float = 1.0,
    part: tuple[Array | int, int] | None = None,
) -> Array:
    """Random noise levels, float32 `shape`: one for each sample, shared by all of its slots.

    `part` = (j, k): from the j-th (from 0) of k equally likely parts of the distribution; one draw from each is a
    stratified sample, whose mean loss varies less than that of k free draws.

    "uniform_index": a point of the training grid, each equally likely. "logit_normal":
    shifted(sigmoid(mean + std n)), the practice of large pre-training runs.
    """
    _known(method, SIGMA_SAMPLERS, "sigma sampler")
    if part is not None:
        quantile = (part[0] + jax.random.uniform(key, shape)) / part[1]
        if method == "uniform_index":
            u = (jnp.floor(quantile * TRAIN_POINTS) + 1.0).clip(1, TRAIN_POINTS) / TRAIN_POINTS
        else:
            u = jax.nn.sigmoid(mean + std * jax.scipy.special.ndtri(quantile))
    elif method == "uniform_index":
        u = jax.random.randint(key, shape, 1, TRAIN_POINTS + 1) / TRAIN_POINTS
    else:
        u = jax.nn.sigmoid(mean + std * jax.random.normal(key, shape))
    return shifted(u.astype(jnp.float32), shift)


def bf16_training_index(index, shift: float = 5.0) -> np.ndarray:
    """The grid point DiffSynth really trains at when it draws `index` [...].

    It rounds the timestep to bfloat16 and looks the result up again, so only 294 of the 1000
    points are ever used. Kept to explain and reproduce checkpoints; not used by our training.
    """
    times = np.float32(1000) * training_table(shift)[0].astype(np.float32)
    rounded = times[np.asarray(index)].astype(jnp.bfloat16).astype(np.float32)
    return np.abs(times - rounded[..., None]).argmin(-1)


# ---- grids for sampling ----------------------------------------------------------------------


def schedule(
    name: str,
    steps: int,
    *,
    shift: float = 5.0,
    power: float = 2.0,
    sigma_min: float = 0.0,
    breaks: Sequence[float] = (),
    solver: str = "euler",
    model: str | None = None,
) -> np.ndarray:
    """A descending grid of noise levels, float64 [steps + 1], last one 0.

    "shift"      linspace(1, 0) shifted: the predecessor's Euler grid (DiffSynth-Studio)
    "unipc"      linspace(0.999, 0) shifted: Wan's own default
    "dpmpp"      Wan's grid for DPM-Solver++; the same points as "shift"
    "uniform"    linspace(1, 0); `shift` does not apply
    "graded"     u^power, finer towards 0; with `sigma_min` it walks to there and jumps to 0
    "optimised"  found offline for `solver` on the weights of `model` (a config's name), read from
                 schedules.json; python -m experiments.quality.optimise_schedules finds them

    `breaks`: noise levels that must be grid points, such as the ends of a guidance interval; the
    pieces between them are stretched, the number of steps stays.
    """
    _known(name, SCHEDULES, "schedule")
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise UserError(
            f"The number of sampling steps is {steps!r}; it must be a whole number >= 1."
        )
    if not shift > 0:
        raise UserError(f"The schedule shift is {shift}; it must be above 0 (1 means no shift).")
    u = np.linspace(1.0, 0.0, steps + 1)
    if name in ("shift", "dpmpp"):
        sigmas = shifted(u, shift)
    elif name == "unipc":  # the official code starts at float32(0.999), not at 0.999
        sigmas = shifted(np.linspace(float(np.float32(0.999)), 0.0, steps + 1), shift)
    elif name == "uniform":
        sigmas = u
    elif name == "graded":
        sigmas = _graded(steps, power, sigma_min)
    else:
        sigmas = _optimised(steps, solver, model)
    sigmas[-1] = 0.0
    return with_breaks(sigmas, breaks)


def _graded(steps: int, power: float, sigma_min: float) -> np.ndarray:
    if not power >= 1:
        raise UserError(f"The grading power is {power}; it must be at least 1 (1 is uniform).")
    if not 0 <= sigma_min < 1:
        raise UserError(f"sigma_min is {sigma_min}; it must lie in [0, 1).")
    if sigma_min == 0:
        return np.linspace(1.0, 0.0, steps + 1) ** power
    if steps == 1:
        return np.array([1.0, 0.0])
    low = sigma_min ** (1 / power)
    return np.append((low + (1 - low) * np.linspace(1.0, 0.0, steps)) ** power, 0.0)


def optimised_grids(model: str) -> dict[str, dict[int, list[float]]]:
    """The stored grids of a model, {solver: {steps: sigmas [steps + 1]}}; empty if there are none."""
    table = (
        json.loads(OPTIMISED_FILE.read_text(encoding="utf-8")) if OPTIMISED_FILE.exists() else {}
    )
    grids = table.get(model, {}).get("grids", {})
    return {solver: {int(n): g for n, g in some.items()} for solver, some in grids.items()}


def _optimised(steps: int, solver: str, model: str | None) -> np.ndarray:
    if model is None:
        raise UserError(
            "An optimised schedule belongs to a model: give model=, the name of its config."
        )
    stored = optimised_grids(model)
    if steps not in stored.get(solver, {}):
        have = "; ".join(f"{name} {'/'.join(map(str, g))}" for name, g in stored.items())
        raise UserError(
            f"No optimised schedule of model '{model}' for solver '{solver}' with {steps} steps is stored; "
            f"there is {have or 'none for this model'}. Use another schedule, or find one with "
            "python -m experiments.quality.optimise_schedules."
        )
    return np.asarray(stored[solver][steps], np.float64)


def with_breaks(sigmas: np.ndarray, breaks: Sequence[float]) -> np.ndarray:
    """The grid with every break inside it moved onto a grid point; same number of points.

    A field that jumps at a noise level (guidance that switches on or off) costs every method its
    order unless the jump is a grid point. The nearest interior point moves to each break and the
    pieces between are stretched, so that the grid stays smooth within each piece.
    """
    sigmas = np.asarray(sigmas, np.float64)
    inner = sorted({float(b) for b in breaks if sigmas[-1] < b < sigmas[0]}, reverse=True)
    count = len(sigmas)
    if not inner:
        return sigmas  # untouched: official timesteps depend on the last bit
    if len(inner) > count - 2:
        raise UserError(
            f"{count - 1} sampling steps cannot meet {len(inner)} guidance ends inside the grid; "
            f"at least {len(inner) + 1} steps are needed."
        )
    index = [0]
    for i, b in enumerate(inner):
        low, high = index[-1] + 1, count - 2 - (len(inner) - 1 - i)
        index.append(low + int(np.abs(sigmas[low : high + 1] - b).argmin()))
    index.append(count - 1)
    fixed = [sigmas[0], *inner, sigmas[-1]]
    out = np.interp(-sigmas, -sigmas[index], fixed)  # interp wants ascending abscissae
    out[index] = fixed
    return out


# ---- schedules found offline --------------------------------------------------------------------


def euler_jump_errors(sigmas: np.ndarray, states: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Squared error of one Euler jump between any two points of a fine teacher trajectory.

    `sigmas` [k] descending, `states` and `velocities` [k, ...] on the teacher's path (several
    samples may share the trailing axes). Returns [k, k]: entry (i, j), i < j, is the mean squared
    difference of x_i + (sigma_j - sigma_i) v_i and x_j; other entries are infinite.
    """
    count = len(sigmas)
    x = np.asarray(states, np.float64).reshape(count, -1)
    v = np.asarray(velocities, np.float64).reshape(count, -1)
    errors = np.full((count, count), np.inf)
    for i in range(count - 1):
        jump = x[i][None] + (np.asarray(sigmas)[i + 1 :] - sigmas[i])[:, None] * v[i][None]
        errors[i, i + 1 :] = np.mean((jump - x[i + 1 :]) ** 2, axis=1)
    return errors


def adams_jump_errors(sigmas: np.ndarray, states: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """As `euler_jump_errors` for a second-order step that remembers the slope of the point before.

    Returns [k, k, k]: entry (p, i, j), p < i < j, is the mean squared error of the two-step
    Adams-Bashforth jump from i to j with the teacher's slopes at p and i; entry (0, 0, j) is the
    Euler start; other entries are infinite.
    """
    s = np.asarray(sigmas, np.float64)
    count = len(s)
    x = np.asarray(states, np.float64).reshape(count, -1)
    v = np.asarray(velocities, np.float64).reshape(count, -1)
    errors = np.full((count, count, count), np.inf)
    errors[0, 0] = euler_jump_errors(s, x, v)[0]
    # |x_j - x_i - h v_i - q (v_i - v_p)|^2 from scalar products: vectors are long, triples are many
    vv = v @ v.T
    for i in range(1, count - 1):
        h = s[i + 1 :] - s[i]  # [j]
        rest = x[i + 1 :] - x[i][None] - h[:, None] * v[i][None]
        bends = v[i][None] - v[:i]  # [p, :]
        q = 0.5 * h[None] ** 2 / (s[i] - s[:i])[:, None]  # [p, j]
        square = np.sum(rest**2, axis=1)[None] - 2 * q * (bends @ rest.T)
        square += q**2 * (vv[i, i] - 2 * vv[i, :i] + np.diag(vv)[:i])[:, None]
        errors[:i, i, i + 1 :] = np.maximum(square, 0.0) / x.shape[1]
    return errors


def optimise_schedule(sigmas: np.ndarray, errors: np.ndarray, steps: int) -> np.ndarray:
    """The `steps`-step grid through the teacher's points with the least total jump error.

    `sigmas` [k] is the teacher's fine grid. `errors` is the cost of jumping from point i to a later
    point j: [k, k] (`euler_jump_errors`), or [k, k, k] where the point p before i matters too
    (`adams_jump_errors`). Exact shortest path with a fixed number of edges, by dynamic programming,
    O(steps k^2) or O(steps k^3). Returns float64 [steps + 1].
    """
    sigmas = np.asarray(sigmas, np.float64)
    count = len(sigmas)
    if not 1 <= steps <= count - 1:
        raise UserError(
            f"{steps} steps cannot be chosen from a teacher with {count - 1}; allowed 1..{count - 1}."
        )
    order = np.arange(count)
    allowed = np.where(order[:, None] < order[None], errors, np.inf)  # [i, j] or [p, i, j]
    if allowed.ndim == 2:
        allowed = np.broadcast_to(allowed[None], (count, count, count))
    cost = np.full((count, count), np.inf)  # [p, i]
    cost[0, 0] = 0.0
    previous = []
    for _ in range(steps):
        total = cost[:, :, None] + allowed
        previous.append(total.argmin(0))  # [i, j] -> p
        cost = total.min(0)
    end = count - 1
    if not np.isfinite(cost[:, end]).any():
        raise UserError(
            "The teacher trajectory holds non-finite errors; no schedule can be chosen."
        )
    path = [end, int(cost[:, end].argmin())]
    for row in reversed(previous):
        path.append(int(row[path[-1], path[-2]]))
    return sigmas[path[-2::-1]]  # the last entry is the point "before" the start


def refine_schedule(
    error: Callable[[np.ndarray], float], grid: np.ndarray, *, rounds: int = 2, reach: float = 0.8
) -> np.ndarray:
    """Move the inner points of `grid` one by one to where `error(grid)` is least.

    `error` runs the sampler itself and returns its end error to a teacher, so this sees what the
    sum of jump errors cannot: how the rest of the path shrinks or grows an early error, and the
    memory of multistep solvers. A point is tried `reach` of the way to either neighbour and at the
    vertex of the parabola through the three errors; the reach halves each round. Two or three calls
    per point and round. The result is never worse than `grid` under `error`.
    """
    grid, best = np.array(grid, np.float64), float(error(grid))

    def attempt(i: int, sigma: float) -> float:
        nonlocal grid, best
        trial = grid.copy()
        trial[i] = sigma
        value = float(error(trial))
        if value < best:
            grid, best = trial, value
        return value

    for k in range(rounds):
        for i in range(1, len(grid) - 1):
            here, middle = grid[i], best
            shifts = reach * 0.5**k * np.array([grid[i - 1] - here, grid[i + 1] - here])
            slopes = [(attempt(i, here + shift) - middle) / shift for shift in shifts]
            curve = (slopes[0] - slopes[1]) / (shifts[0] - shifts[1])
            if curve > 0:  # not for NaN: a grid that fails
                vertex = -0.5 * (slopes[0] - curve * shifts[0]) / curve
                if shifts[1] < vertex < shifts[0]:
                    attempt(i, here + vertex)
    return grid


def _known(word: str, options: Sequence[str], what: str) -> None:
    if word not in options:
        raise UserError(f"Unknown {what} '{word}'; {did_you_mean(word, options)}")
