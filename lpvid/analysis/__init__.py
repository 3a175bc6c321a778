"""Fit metrics, residual tests, prediction, uncertainty, norms and gains along the frequency."""

from lpvid.analysis._band_fit import band_fit as band_fit
from lpvid.analysis._band_fit import band_lines as band_lines
from lpvid.analysis._eigensolvers import AbstractEigensolver as AbstractEigensolver
from lpvid.analysis._eigensolvers import Lapack as Lapack
from lpvid.analysis._eigensolvers import SimultaneousIteration as SimultaneousIteration
from lpvid.analysis._h2 import h2_norm as h2_norm
from lpvid.analysis._hinf import HinfNorm as HinfNorm
from lpvid.analysis._hinf import hinf_norm as hinf_norm
from lpvid.analysis._metrics import bft as bft
from lpvid.analysis._metrics import nrmse_fit as nrmse_fit
from lpvid.analysis._metrics import parameter_fit as parameter_fit
from lpvid.analysis._metrics import relative_error as relative_error
from lpvid.analysis._metrics import vaf as vaf
from lpvid.analysis._peak_frequencies import peak_frequencies as peak_frequencies
from lpvid.analysis._predict import HorizonErrors as HorizonErrors
from lpvid.analysis._predict import fit_by_record as fit_by_record
from lpvid.analysis._predict import horizon_errors as horizon_errors
from lpvid.analysis._predict import predict as predict
from lpvid.analysis._residual_tests import ResidualTests as ResidualTests
from lpvid.analysis._residual_tests import residual_tests as residual_tests
from lpvid.analysis._response import singular_values as singular_values
from lpvid.analysis._uncertainty import PoleUncertainty as PoleUncertainty
from lpvid.analysis._uncertainty import ResponseUncertainty as ResponseUncertainty
from lpvid.analysis._uncertainty import (
    frequency_response_covariance as frequency_response_covariance,
)
from lpvid.analysis._uncertainty import pole_covariance as pole_covariance
from lpvid.analysis._uncertainty import propagate as propagate
