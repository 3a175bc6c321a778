"""Plots: results in, Matplotlib axes out. Nothing is shown and no global setting is changed.

Every function takes `axes=` (draw there; new ones are made otherwise) and returns the axes it
drew on. Matplotlib is imported when the first plot is drawn, not with lpvid.
"""

from lpvid.plot._control import closed_loop_response as closed_loop_response
from lpvid.plot._control import loop_bode as loop_bode
from lpvid.plot._control import nyquist as nyquist
from lpvid.plot._figure import png_bytes as png_bytes
from lpvid.plot._figure import save_figure as save_figure
from lpvid.plot._frequency import bode as bode
from lpvid.plot._frequency import singular_values as singular_values
from lpvid.plot._horizon import horizon_errors as horizon_errors
from lpvid.plot._intervals import parameter_intervals as parameter_intervals
from lpvid.plot._intervals import profile_likelihood as profile_likelihood
from lpvid.plot._loop import loop as loop
from lpvid.plot._loop_findings import candidate_ranking as candidate_ranking
from lpvid.plot._loop_findings import error_ladder as error_ladder
from lpvid.plot._loop_findings import virtual_forces as virtual_forces
from lpvid.plot._loop_signals import loop_residuals as loop_residuals
from lpvid.plot._loop_signals import loop_responses as loop_responses
from lpvid.plot._loop_signals import loop_spectra as loop_spectra
from lpvid.plot._modal_responses import modal_reduction as modal_reduction
from lpvid.plot._modal_responses import modal_responses as modal_responses
from lpvid.plot._parameters import parameters as parameters
from lpvid.plot._poles import mode_frequencies as mode_frequencies
from lpvid.plot._poles import poles as poles
from lpvid.plot._residual_tests import residual_tests as residual_tests
from lpvid.plot._residuals import residuals as residuals
from lpvid.plot._scheduling import closed_loop_motions as closed_loop_motions
from lpvid.plot._scheduling import schedule_margins as schedule_margins
from lpvid.plot._scheduling import scheduled_gains as scheduled_gains
from lpvid.plot._search import fit_over_points as fit_over_points
from lpvid.plot._search import minima as minima
from lpvid.plot._search import scree as scree
from lpvid.plot._stabilisation import stabilisation as stabilisation
from lpvid.plot._time import compare as compare
from lpvid.plot._time import records as records
from lpvid.plot._validation import validation as validation
