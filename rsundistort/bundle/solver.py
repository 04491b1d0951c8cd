"""Levenberg-Marquardt, independent of cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..model.array_types import Array

__all__ = ["LinearSystem", "MinimizeResult", "Problem", "minimize"]

# Steps that achieve less than this share of the predicted decrease have met a bend of the valley.
_GOOD_STEP = 0.8
# Damping that is lost in rounding. From far below, many steps would be rejected until damping has an effect again.
_LEAST_DAMPING = 1e-12


class LinearSystem(Protocol):
    """Normal equations at one state."""

    cost: float

    def solve(self, damping: float) -> tuple[Any, float] | None:
        """The step at a damping and the decrease it predicts; None if the system cannot be factored."""


class Problem(Protocol):
    """A problem of least squares."""

    def linearize(self, state: Any, spent: Any = None) -> LinearSystem:
        """Normal equations and cost at a state; they may be written over those of `spent`, no longer needed."""

    def retract(self, state: Any, step: Any) -> Any:
        """The state after a step."""

    def cost(self, state: Any) -> float:
        """The cost of a state."""

    def settle(self, state: Any, before: Any) -> Any:
        """A state of lower cost, found in less time than the step from `before`, which was predicted badly."""

    def step_size(self, state: Any, step: Any) -> float:
        """Largest change of an unknown in natural units (radians, scene sizes)."""


@dataclass(frozen=True)
class MinimizeResult:
    """Last state, why the loop stopped, the costs of the accepted states, and the damping of the next step."""

    state: Any
    stop_reason: str
    cost_history: Array
    num_iterations: int
    damping: float


def minimize(
    problem: Problem,
    state: Any,
    *,
    max_iterations: int,
    cost_tolerance: float,
    step_tolerance: float,
    initial_damping: float,
    max_damping: float,
    progress: Callable[[float], None] | None = None,
) -> MinimizeResult:
    """Minimise a problem's cost.

    Damping after H. B. Nielsen: the better the quadratic model predicted the decrease, the more damping falls. A step
    whose decrease was predicted badly is settled before it is judged (Jeong et al., "Pushing the envelope of modern
    methods for bundle adjustment", 2012, do so with every step): narrow views need half the steps.
    """
    system = problem.linearize(state)
    cost = system.cost
    history = [cost]
    damping, growth = initial_damping, 2.0
    reason = "iterations"
    iteration = 0
    while iteration < max_iterations:
        iteration += 1
        solved = system.solve(damping)
        accepted = False
        if solved is not None:
            step, predicted = solved
            candidate = problem.retract(state, step)
            new_cost = problem.cost(candidate)
            is_good = cost - new_cost > _GOOD_STEP * predicted
            if not is_good and (predicted > cost_tolerance * cost or new_cost > cost):
                candidate = problem.settle(candidate, state)
                new_cost = problem.cost(candidate)
            decrease = cost - new_cost
            small_step = problem.step_size(state, step) < step_tolerance
            if np.isfinite(new_cost) and decrease > 0 and predicted > 0:
                accepted = True
                damping *= max(1.0 / 10.0, 1.0 - (2.0 * decrease / predicted - 1.0) ** 3)
                damping = max(damping, _LEAST_DAMPING)
                growth = 2.0
                state, cost = candidate, new_cost
                history.append(cost)
                if progress is not None:
                    progress(cost)
                if decrease < cost_tolerance * cost:
                    reason = "cost"
                    break
            if small_step:
                reason = "step"
                break
        if accepted:
            system = problem.linearize(state, system)
        else:
            damping *= growth
            growth *= 2.0
            if damping > max_damping:
                reason = "damping"
                break
    return MinimizeResult(state, reason, np.array(history), iteration, damping)
