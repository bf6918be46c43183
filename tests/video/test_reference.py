"""The implicit reference: tableaux, orders, stiff problems, and when it refuses to answer."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from roge_jax.errors import UserError
from roge_jax.video import flow, reference, testbed
from roge_jax.video.reference import (
    ReferenceRejected,
    integrate,
    nodes,
    reference_solution,
    tableau,
)


@pytest.mark.parametrize("family", ["gauss", "radau"])
@pytest.mark.parametrize("stages", [1, 2, 3, 5, 9])
def test_tableaux_meet_the_order_conditions(family, stages):
    a, b, c = tableau(family, stages)
    assert b.sum() == pytest.approx(1, abs=1e-14)
    order = 2 * stages - (family == "radau")
    for k in range(1, order + 1):  # B(p): quadrature
        assert b @ c ** (k - 1) == pytest.approx(1 / k, abs=1e-13)
    assert abs(b @ c**order - 1 / (order + 1)) > 1e-13 or order > 12  # and no further
    for k in range(1, stages + 1):  # C(s): stages
        np.testing.assert_allclose(a @ c ** (k - 1), c**k / k, rtol=0, atol=1e-13)
    # growth at z -> -infinity: 1 for Gauss (A-stable only), 0 for Radau IIA (L-stable)
    growth = 1 - b @ np.linalg.solve(a, np.ones(stages))
    assert abs(growth) == pytest.approx(1 if family == "gauss" else 0, abs=1e-11)
    assert nodes(family, stages)[-1] == 1 if family == "radau" else nodes(family, stages)[-1] < 1


def test_known_tableaux():
    a, _, c = tableau("radau", 2)
    np.testing.assert_allclose(a, [[5 / 12, -1 / 12], [3 / 4, 1 / 4]], atol=1e-15)
    np.testing.assert_allclose(c, [1 / 3, 1], atol=1e-15)
    np.testing.assert_allclose(tableau("gauss", 1)[0], [[0.5]], atol=1e-15)
    with pytest.raises(UserError, match="did you mean 'radau'"):
        tableau("radua", 2)


relaxation = functools.cache(testbed.prothero_robinson)


@pytest.mark.parametrize(
    "rate, family, stages, order",
    [
        (-1.0, "gauss", 3, 6),
        (-1.0, "radau", 3, 5),
        # order reduction in the stiff limit: the stage order s, and Radau divides by the rate
        (-1e6, "gauss", 3, 4),
        (-1e6, "radau", 3, 3),
    ],
)
def test_orders_on_prothero_robinson_and_their_reduction(rate, family, stages, order):
    with jax.enable_x64(True):
        problem, start = relaxation(rate)
        errors = []
        for n in (1, 2, 4):  # with 8 steps Radau's 1e-11 is rounding: a rate of 1e6 on 1e-16
            grid = np.linspace(1, 0, n + 1)
            x, report = integrate(
                problem.velocity, start, grid, family=family, stages=stages, end_inside=False
            )
            assert int(report["failed"]) == 0
            errors.append(abs(float(x[0]) - np.cos(1)))
        observed = np.log2(errors[:-1]) - np.log2(errors[1:])
        assert observed[-1] == pytest.approx(order, abs=0.3)
        if rate == -1e6 and family == "radau":
            assert max(errors) < 1e-7  # damped by 1 / rate; Gauss has 1e-5 here


@pytest.mark.parametrize("name", ["van_der_pol", "hires"])
def test_stiff_problems_agree_with_scipy(name):
    from scipy.integrate import solve_ivp

    with jax.enable_x64(True):
        make = {"van_der_pol": lambda: testbed.van_der_pol(10.0, 12.0), "hires": testbed.hires}
        problem, start = make[name]()
        # time runs 0 -> 1 = sigma 1 -> 0; HIRES needs short steps first, geometric growth after
        time = np.linspace(0, 1, 401) if name == "van_der_pol" else np.expm1(np.linspace(0, 8, 401))
        grid = 1 - time / time[-1]
        x, report = integrate(problem.velocity, start, grid, stages=5, end_inside=False)
        assert int(report["failed"]) == 0
        jitted = jax.jit(problem.velocity)
        oracle = solve_ivp(
            lambda t, y: -np.asarray(jitted(y, 1 - t)),
            (0, 1),
            start,
            method="LSODA",
            rtol=1e-10,
            atol=1e-13,
        ).y[:, -1]
        assert np.linalg.norm(x - oracle) < 1e-5 * np.linalg.norm(oracle)


def test_failed_steps_are_reported_not_hidden():
    def field(x, sigma):  # a root that Newton cannot reach: the field ends at sigma = 0.5
        return jnp.where(sigma > 0.5, x, jnp.nan)

    _, report = integrate(field, jnp.ones(3), np.linspace(1, 0, 9))
    # the step 0.625 -> 0.5 looks at its end from inside and is fine; the next one cannot be
    assert int(report["first"]) == 4 and int(report["failed"]) == 4


def test_a_step_that_ran_out_of_iterations_is_a_failed_step():
    """Its numbers are finite and nearly right: only the solver's status tells."""
    grid = flow.schedule("graded", 12, power=3)
    with jax.enable_x64(True):
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)))
        for most, failed in ((3, 12), (100, 0)):
            x0, report = integrate(
                *(tight.velocity, x1, grid), stages=4, stepper="picard", max_iterations=most
            )
            assert np.isfinite(x0).all() and int(report["failed"]) == failed
            assert int(report["first"]) == (0 if failed else -1)


tight = testbed.gaussian([0.3, -1.0, 2.0, 0.1], [0.02, 0.3, 1.0, 1.5])


@pytest.mark.parametrize("stepper", ["newton", "picard"])
def test_reference_meets_the_exact_flow(stepper):
    with jax.enable_x64(True):
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)))
        found = reference_solution(tight.velocity, x1, stepper=stepper, tolerance=1e-8)
        assert found.self_error <= 1e-8
        exact = tight.exact(x1)
        assert float(jnp.linalg.norm(found.x0 - exact) / jnp.linalg.norm(exact)) <= found.self_error


def test_conditional_flow_is_the_posterior_and_the_reference_of_its_field():
    matrix, observed, noise = np.array([[1.0, 0.5, 0.0], [0.0, -1.0, 0.7]]), [0.8, -0.3], 0.2
    # the posterior by Kalman's gain, which the test-bed does not use
    gain = matrix.T @ np.linalg.inv(matrix @ matrix.T + noise**2 * np.eye(2))
    covariance = np.eye(3) - gain @ matrix
    with jax.enable_x64(True):
        problem = testbed.conditional(matrix, observed, noise)
        # x1 ~ N(0, I) is mapped to mean + A x1 with A A^T = covariance
        np.testing.assert_allclose(problem.exact(jnp.zeros(3)), gain @ observed, atol=1e-12)
        linear = jax.jacobian(problem.exact)(jnp.zeros(3))
        np.testing.assert_allclose(linear @ linear.T, covariance, atol=1e-12)
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3)))
        found = reference_solution(problem.velocity, x1, stepper="picard", tolerance=1e-8)
        gap = jnp.linalg.norm(found.x0 - problem.exact(x1)) / jnp.linalg.norm(found.x0)
        assert float(gap) <= found.self_error <= 1e-8


POINTS = np.array([[1.0, 0.2], [-0.8, 0.9], [-0.1, -1.1]])


def test_empirical_field_is_the_mean_velocity_towards_the_data():
    """v = (x - E[x0 | x]) / sigma with E[x0 | x] by summing over points and a quadrature of each point's blur."""
    std, sigma, x = 0.3, 0.6, np.array([0.4, -0.2])
    nodes_1d, weights_1d = np.polynomial.hermite_e.hermegauss(40)
    offset = np.stack(np.meshgrid(nodes_1d, nodes_1d), -1).reshape(-1, 2) * std
    x0 = POINTS[:, None] + offset  # [k, q, 2]
    prior = np.outer(weights_1d, weights_1d).ravel()
    likelihood = prior * np.exp(-0.5 * np.sum((x - (1 - sigma) * x0) ** 2, -1) / sigma**2)
    mean = np.einsum("kq,kqd->d", likelihood, x0) / likelihood.sum()
    with jax.enable_x64(True):
        field = testbed.empirical(POINTS, std).velocity(jnp.asarray(x), jnp.float64(sigma))
        np.testing.assert_allclose(field, (x - mean) / sigma, rtol=1e-9)


def test_empirical_flow_keeps_quantiles_on_a_line_and_memorises_in_the_plane():
    std = 0.02
    with jax.enable_x64(True):
        line = testbed.empirical(np.array([[-1.0], [0.1], [0.9]]), 0.3)
        x1 = jnp.linspace(-2.0, 2.0, 5)[:, None]
        found = reference_solution(line.velocity, x1, stepper="picard", tolerance=1e-8)
        gap = jnp.linalg.norm(found.x0 - line.exact(x1)) / jnp.linalg.norm(found.x0)
        assert float(gap) <= found.self_error <= 1e-8
        plane = testbed.empirical(POINTS, std)
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(16, 2)))
        grid = flow.schedule("graded", 48, power=3)
        x0, report = integrate(plane.velocity, x1, grid, stages=4, stepper="picard")
        assert int(report["failed"]) == 0
        distance = np.linalg.norm(np.asarray(x0)[:, None] - POINTS, axis=-1)  # [n, k]
        assert distance.min(1).max() < 4 * std
        assert set(distance.argmin(1)) == {0, 1, 2}


def test_matrix_free_newton_equals_dense_newton_and_picard():
    with jax.enable_x64(True):
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)))
        grid = flow.schedule("graded", 12, power=3)
        ends = {}
        for stepper in ("newton", "newton_krylov", "picard"):
            ends[stepper], report = integrate(tight.velocity, x1, grid, stages=4, stepper=stepper)
            assert int(report["failed"]) == 0
        np.testing.assert_allclose(ends["newton_krylov"], ends["newton"], rtol=0, atol=1e-11)
        np.testing.assert_allclose(ends["picard"], ends["newton"], rtol=0, atol=1e-11)


def test_reference_refuses_a_jump_unless_it_is_named():
    with jax.enable_x64(True):
        problem = testbed.guided_mixture(4.0, (0.313, 0.787), dim=2)
        x1 = np.random.default_rng(0).normal(size=(2, 2))
        arguments = {"tolerance": 1e-7, "stepper": "picard", "doublings": 2}
        found = reference_solution(problem.velocity, x1, breaks=problem.breaks, **arguments)
        assert found.self_error <= 1e-7
        with pytest.raises(ReferenceRejected, match=r"candidates differ .* name the noise levels"):
            reference_solution(problem.velocity, x1, **arguments)


def test_reference_refuses_unconverged_steps():
    with jax.enable_x64(True):
        problem, start = testbed.dahlquist(-1e6)  # Picard contracts only for |h rate| below ~1
        with pytest.raises(ReferenceRejected, match="did not converge, the first from sigma 1"):
            reference_solution(problem.velocity, start, stepper="picard", doublings=0)


# (grid points, family, stages) of the candidates that are spoiled, and the only comparison that can see it
SPOILED = {
    "halved step": lambda points, family, stages: points == 49,
    "higher order": lambda points, family, stages: (family, stages) == ("radau", 4),
    "other family": lambda points, family, stages: family == "gauss",
}


@pytest.mark.parametrize("name", SPOILED)
def test_each_of_the_three_comparisons_rejects_alone(name, monkeypatch):
    """Weights of some candidates that are off by 1e-4: two comparisons are between equals, the third is not."""
    plan = reference._plan

    def spoiled(grid, family, stages, inside):
        padded, count, (a, b, c), last = plan(grid, family, stages, inside)
        worse = 1.0001 if SPOILED[name](len(grid), family, stages) else 1.0
        return padded, count, (a, worse * b, c), last

    with jax.enable_x64(True):
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)))
        run = functools.partial(
            reference_solution, tight.velocity, x1, stepper="picard", steps=48, doublings=0
        )
        assert run(tolerance=1e-6).steps == 96
        monkeypatch.setattr(reference, "_plan", spoiled)
        with pytest.raises(ReferenceRejected) as caught:
            run(tolerance=1e-6)
    found = re.findall(r"(\w+ \w+) (\d\.\d+e-\d+)", str(caught.value))
    gaps = {word: float(gap) for word, gap in found}
    assert gaps.keys() == SPOILED.keys()
    assert {word for word, gap in gaps.items() if gap > 1e-6} == {name}


def test_reference_refuses_candidates_that_agree_when_a_step_of_one_failed(monkeypatch):
    walker = reference._walker

    def failing(*arguments):
        walk = walker(*arguments)

        def one_failed(x1, grid, count, main, last):
            x0, report = walk(x1, grid, count, main, last)
            if len(main[2]) == 5:  # the candidate of higher order
                report = report | {"failed": jnp.int32(1), "first": jnp.int32(2)}
            return x0, report

        return one_failed

    with jax.enable_x64(True):
        x1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 4)))
        monkeypatch.setattr(reference, "_walker", failing)
        with pytest.raises(ReferenceRejected, match=r"higher order: 1 of .* did not converge"):
            reference_solution(tight.velocity, x1, stepper="picard", steps=48, doublings=0)


def test_reference_never_looks_at_zero():
    with jax.enable_x64(True):
        problem = testbed.delta([0.5, -2.0])  # 0/0 at sigma = 0
        x0, report = integrate(problem.velocity, jnp.ones(2), flow.schedule("graded", 8), stages=2)
        assert int(report["failed"]) == 0
        np.testing.assert_allclose(x0, [0.5, -2.0], atol=1e-12)


def test_grid_of_the_caller_is_refined_not_replaced():
    with jax.enable_x64(True):
        grid = flow.schedule("graded", 6, sigma_min=0.05)[:-1]  # stops at sigma = 0.05
        x1 = jnp.ones((2, 4))
        found = reference_solution(tight.velocity, x1, sigmas=grid, steps=12, stepper="picard")
        np.testing.assert_allclose(found.x0, tight.exact(x1, 1.0, 0.05), rtol=1e-8)
