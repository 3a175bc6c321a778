"""Differentiable system identification and linear parameter-varying (LPV) modelling."""

from lpvid import _runtime

_runtime.configure()

__version__ = "0.1.0"

from lpvid import analysis as analysis
from lpvid import data as data
from lpvid import mechanics as mechanics
from lpvid import models as models
from lpvid import plot as plot
from lpvid import study as study
from lpvid._results import Status as Status
from lpvid.analysis import HinfNorm as HinfNorm
from lpvid.analysis import band_fit as band_fit
from lpvid.analysis import bft as bft
from lpvid.analysis import h2_norm as h2_norm
from lpvid.analysis import hinf_norm as hinf_norm
from lpvid.analysis import nrmse_fit as nrmse_fit
from lpvid.analysis import parameter_fit as parameter_fit
from lpvid.analysis import relative_error as relative_error
from lpvid.analysis import vaf as vaf
from lpvid.data import DataError as DataError
from lpvid.data import Decimate as Decimate
from lpvid.data import Detrend as Detrend
from lpvid.data import IOData as IOData
from lpvid.data import Lowpass as Lowpass
from lpvid.data import Offset as Offset
from lpvid.data import PeriodicBand as PeriodicBand
from lpvid.data import Scale as Scale
from lpvid.data import from_pandas as from_pandas
from lpvid.data import join as join
from lpvid.data import preprocess as preprocess
from lpvid.data import read as read
from lpvid.data import read_csv as read_csv
from lpvid.data import read_mat as read_mat
from lpvid.data import read_npz as read_npz
from lpvid.identify import Fit as Fit
from lpvid.identify import PastInputMOESP as PastInputMOESP
from lpvid.identify import PastOutputMOESP as PastOutputMOESP
from lpvid.identify import estimate_initial_state as estimate_initial_state
from lpvid.identify import identify as identify
from lpvid.identify import simulation_fit as simulation_fit
from lpvid.interpolate import balance_along as balance_along
from lpvid.interpolate import interpolate as interpolate
from lpvid.interpolate import interpolate_balanced as interpolate_balanced
from lpvid.interpolate import interpolation_fit as interpolation_fit
from lpvid.interpolate import leave_one_out as leave_one_out
from lpvid.io import ModelFileError as ModelFileError
from lpvid.io import load as load
from lpvid.io import save as save
from lpvid.models import AbstractStructure as AbstractStructure
from lpvid.models import AlignedAverage as AlignedAverage
from lpvid.models import FreeStructure as FreeStructure
from lpvid.models import FunctionStructure as FunctionStructure
from lpvid.models import LPVStateSpace as LPVStateSpace
from lpvid.models import MechanicalStructure as MechanicalStructure
from lpvid.models import ModalStructure as ModalStructure
from lpvid.models import NaiveAverage as NaiveAverage
from lpvid.models import Polynomial as Polynomial
from lpvid.models import StateSpace as StateSpace
from lpvid.models import Tustin as Tustin
from lpvid.models import ZeroOrderHold as ZeroOrderHold
from lpvid.models import average as average
from lpvid.models import balance as balance
from lpvid.models import c2d as c2d
from lpvid.models import d2c as d2c
from lpvid.models import from_control as from_control
from lpvid.models import from_scipy as from_scipy
from lpvid.models import modal_form as modal_form
from lpvid.models import to_control as to_control
from lpvid.models import to_scipy as to_scipy
from lpvid.report import Report as Report
from lpvid.restructure import HinfMatching as HinfMatching
from lpvid.restructure import Restructured as Restructured
from lpvid.restructure import restructure as restructure
from lpvid.restructure import restructure_along as restructure_along
