"""Continuous-time models from records that settle: step responses and their like."""

from lpvid.identify.step._deviations import DeviationSubspace as DeviationSubspace
from lpvid.identify.step._identify import StepResponseFit as StepResponseFit
from lpvid.identify.step._identify import identify_step_response as identify_step_response
from lpvid.identify.step._method import AbstractStepMethod as AbstractStepMethod
from lpvid.identify.step._moment_methods import DualRealisation as DualRealisation
from lpvid.identify.step._moment_methods import PrimalRealisation as PrimalRealisation
