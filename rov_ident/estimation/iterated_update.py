"""Samples that were linearised about poor estimates, linearised again about better ones.

What a sample tells is right to first order in the error of the coefficients that it is linearised
about. While little is known, samples claim combinations of coefficients that the motion does not
determine, and no later one corrects that ("Looking back" in docs/choices.md). So the samples of a
window are kept with the state from before them, and folded again from it, about the present
estimate, once that has moved: the iterated update (Bell and Cathey 1993, IEEE Trans. Automat.
Contr. 38, 294), a Gauss-Newton step.
"""

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rov_ident.core.jit import interpreting
from rov_ident.core.messages import Array
from rov_ident.core.threads import one_blas_thread
from rov_ident.estimation.shared import Problem
from rov_ident.sampling.sample import joined

# s after the beginning of a window, which ends with the last; doubled, so that a pass folds at most
# twice as many samples again as come in. "Looking back" has the study.
_TIMES = (7.5, 15.0, 30.0)
_PASSES = 4  # two are enough where it ends at all
_LARGEST_CHANGE = 1.0  # standard deviations, by which an estimate may be off in any case


class IteratedUpdate:
    """The samples of a window and the state before them; begins with a ``state`` of an estimator,
    the ``module``."""

    def __init__(self, module: ModuleType, state: Any) -> None:
        self._module = module
        self.begin(state)

    def begin(self, state: Any) -> None:
        """A new window: what was learnt before stays as it is."""
        self._before, self._samples = state, list[NDArray[np.void]]()
        self._about: Array = self._module.about_of(state)
        self._began, self._looks = np.nan, 0

    def until_due(self, samples: NDArray[np.void]) -> int:
        """How many of the next samples (k,) are to be folded before :meth:`after` is asked."""
        if np.isnan(self._began) and len(samples):
            self._began = float(samples["t"][0])
        due = self._began + _TIMES[self._looks]
        if samples["t"][-1] < due:
            return len(samples)
        return int(np.argmax(samples["t"] >= due)) + 1

    def after(self, task: Problem, state: Any, samples: NDArray[np.void]) -> Any:
        """The state to go on with, after these samples (k,) were folded."""
        self._samples.append(samples)
        if samples["t"][-1] < self._began + _TIMES[self._looks]:
            return state
        state = self.iterate(task, state)
        self._looks += 1
        if self._looks == len(_TIMES):
            self.begin(state)
        return state

    @one_blas_thread()
    def iterate(self, task: Problem, state: Any) -> Any:
        """The state with the window's samples folded about its estimate, if that has moved.

        Repeated until rows and the estimate that follows from them agree; where they never do, too
        little is known yet, and the state stays. So it does while kernels are interpreted, when all
        this would take minutes.
        """
        if interpreting() or not self._samples:
            return state
        about, std = self._module.solution_of(state)
        # what has walked further meanwhile than it is known to has no one value in the window
        elapsed = self._samples[-1]["t"][-1] - self._began
        one_value = task.drift * elapsed <= std**2
        if not _differ(about[one_value], self._about[one_value], std[one_value]):
            return state
        samples = joined(self._samples)
        for _ in range(_PASSES):
            again = self._module.fold_about(task, self._before, samples, about)
            if again is None:
                break
            solution, std = self._module.solution_of(again)
            if not _differ(solution, about, std):
                self._about = about
                return again
            about = solution
        return state


def _differ(a: Array, b: Array, std: Array) -> bool:
    return bool((np.abs(a - b) > _LARGEST_CHANGE * std).any())
