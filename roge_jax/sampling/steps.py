"""From noise to a sample, step by step: a sampler by name, or one's own, around the compiled velocity of a window."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ..config import RoGeConfig
from ..errors import UserError
from ..video import solve_info, solvers
from . import programs
from .settings import Settings


class Bar(Protocol):
    """What is told how far a video is: tqdm's bars are such."""

    def reset(self, total: float | None = None) -> Any: ...

    def update(self, n: float = 1) -> Any: ...

    def set_description(self, desc: str) -> Any: ...

    def close(self) -> Any: ...


def integrate(
    run: programs.Programs,
    params,
    prepared,
    noise,
    grid,
    settings: Settings,
    config: RoGeConfig,
    bar,
):
    """(latents of all slots, evaluations): noise to sample, one evaluation per step of the bar."""
    arguments = run, params, prepared, noise, grid, settings, config, bar
    if callable(settings.solver):
        return _by_own(settings.solver, *arguments)
    if solvers.SOLVERS[settings.solver].method is None:  # adaptive: one program, no steps to show

        @jax.jit
        def whole(params, prepared, noise):
            def field(x, sigma):
                return programs.velocity(
                    params, prepared, noise, x, sigma, config=config, slots=settings.slots
                )

            return solvers.solve(settings.solver, field, noise, grid)

        x0, info = whole(params, prepared, noise)
        solvers.raise_if_failed(info)
        bar.update(int(info.evaluations))
        return x0, int(info.evaluations)

    def field(x, sigma):
        return run.velocity(params, prepared, noise, x, sigma)

    done, x = 0, noise
    for count, _, state in solvers.iterate(settings.solver, field, noise, grid):
        bar.update(1)
        done, x = count, state
    return jax.block_until_ready(x), done


def _by_own(sampler: solvers.Sampler, run, params, prepared, noise, grid, settings, config, bar):
    """`integrate` by a function of the user's. The compiled velocity serves calls from Python; where the function is
    traced (`jax.jit`, `lax.scan`) the velocity is traced with it. Raises: SamplingError at a number that is not finite.
    """
    info, count = solve_info.fresh_info(noise.size, noise.dtype), 0

    def counted():
        nonlocal count
        count += 1
        bar.update(1)

    def checked(x, cause, sigma):
        solvers.raise_if_failed(
            solve_info.note(info.replace(evaluations=count), x, cause, count, sigma)
        )

    def velocity(x, sigma):
        if isinstance(x, jax.core.Tracer) or isinstance(sigma, jax.core.Tracer):
            jax.debug.callback(counted)
            sigma = jnp.asarray(sigma, jnp.float32)
            options = {"config": config, "slots": settings.slots}
            return programs.velocity(params, prepared, noise, x, sigma, **options)
        x, sigma = jnp.asarray(x, noise.dtype), jnp.float32(sigma)
        checked(x, solve_info.BAD_STATE, sigma)
        v = run.velocity(params, prepared, noise, x, sigma)
        counted()
        checked(v, solve_info.BAD_VELOCITY, sigma)
        return v

    x0 = jax.block_until_ready(sampler(velocity, noise, grid))
    jax.effects_barrier()
    if np.shape(x0) != noise.shape:
        raise UserError(
            f"The sampler returned an array of shape {np.shape(x0)} for noise of shape {noise.shape}: return the latents "
            "of all slots, as velocity(x, sigma) takes them."
        )
    x0 = jnp.asarray(x0, noise.dtype)
    checked(x0, solve_info.BAD_STATE, grid[-1])
    return x0, count


def started(progress: bool | Bar, settings: Settings, grid: np.ndarray, runs: int) -> Bar:
    """The bar over all evaluations of `runs` windows: the given one, or a new one; without a total where the sampler
    chooses its own steps."""
    from tqdm import tqdm

    total = None
    if isinstance(settings.solver, str) and solvers.SOLVERS[settings.solver].method is not None:
        total = runs * len(solvers.tabulate(settings.solver, grid).sigma)
    if not isinstance(progress, bool):
        progress.reset(total)
        return progress
    return tqdm(total=total, desc="sampling", unit="step", disable=not progress, dynamic_ncols=True)
