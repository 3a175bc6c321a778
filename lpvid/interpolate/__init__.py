"""Interpolation of local models to one global LPV model (001, section 3.3.2)."""

from lpvid.interpolate._coherent import align_along as align_along
from lpvid.interpolate._coherent import balance_along as balance_along
from lpvid.interpolate._coherent import modal_along as modal_along
from lpvid.interpolate._interpolate import interpolate as interpolate
from lpvid.interpolate._interpolate import interpolate_balanced as interpolate_balanced
from lpvid.interpolate._interpolate import interpolation_fit as interpolation_fit
from lpvid.interpolate._leave_one_out import leave_one_out as leave_one_out
from lpvid.interpolate._leave_one_out import left_out_error as left_out_error
