"""The study of Vizer et al. (2015): noisy local records to a global LPV model, and its check."""

from lpvid.study._monte_carlo import MonteCarloResult as MonteCarloResult
from lpvid.study._monte_carlo import RestructuredRun as RestructuredRun
from lpvid.study._monte_carlo import Sweep as Sweep
from lpvid.study._monte_carlo import run_monte_carlo as run_monte_carlo
from lpvid.study._study import MODEL_NAMES as MODEL_NAMES
from lpvid.study._study import StudyResult as StudyResult
from lpvid.study._study import run_study as run_study
from lpvid.study._study import summary as summary
from lpvid.study._undeclared import Undeclared as Undeclared
from lpvid.study._undeclared import undeclared_record as undeclared_record
