"""Identification of black-box models from records."""

from lpvid.identify._identify import Fit as Fit
from lpvid.identify._identify import identify as identify
from lpvid.identify._initial_state import estimate_initial_state as estimate_initial_state
from lpvid.identify._initial_state import simulation_fit as simulation_fit
from lpvid.identify._methods import AbstractSubspaceMethod as AbstractSubspaceMethod
from lpvid.identify._methods import PastInputMOESP as PastInputMOESP
from lpvid.identify._methods import PastOutputMOESP as PastOutputMOESP
