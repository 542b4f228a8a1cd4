"""Settings of a descent on a loss."""

from dataclasses import dataclass
from typing import Literal

Solver = Literal["gauss-newton", "lbfgs", "adam"]


@dataclass(frozen=True)
class DescentSettings:
    """A descent on a loss; the paper's names in brackets."""

    solver: Solver = "adam"
    num_iterations: int = 100  # [N_iter] of the solver
    step_size: float = 0.1  # Adam's first step [rad, m]
    step_decay: float = 0.8  # factor on the step whenever the loss has not fallen for `patience` iterations
    patience: int = 5
    use_visibility: bool = True  # leave out the points that the camera can't see
    num_culls: int = 4  # times during the descent at which hidden points are left out anew
