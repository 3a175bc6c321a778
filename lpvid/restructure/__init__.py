"""Restructuring: black boxes into structured models by the H∞ norm of the difference."""

from lpvid.restructure._restructure import HinfMatching as HinfMatching
from lpvid.restructure._restructure import Restructured as Restructured
from lpvid.restructure._restructure import restructure as restructure
from lpvid.restructure._restructure import restructure_along as restructure_along
