"""Fit metrics, system norms and gains along the frequency axis."""

from lpvid.analysis._band_fit import band_fit as band_fit
from lpvid.analysis._band_fit import band_lines as band_lines
from lpvid.analysis._h2 import h2_norm as h2_norm
from lpvid.analysis._hinf import HinfNorm as HinfNorm
from lpvid.analysis._hinf import hinf_norm as hinf_norm
from lpvid.analysis._metrics import bft as bft
from lpvid.analysis._metrics import nrmse_fit as nrmse_fit
from lpvid.analysis._metrics import parameter_fit as parameter_fit
from lpvid.analysis._metrics import relative_error as relative_error
from lpvid.analysis._metrics import vaf as vaf
from lpvid.analysis._peak_frequencies import peak_frequencies as peak_frequencies
from lpvid.analysis._response import singular_values as singular_values
