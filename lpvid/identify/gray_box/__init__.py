"""Continuous-time identification from filtered signals: black boxes, and M, D, K of mechanics."""

from lpvid.identify.gray_box._black_box import ContinuousTimeFit as ContinuousTimeFit
from lpvid.identify.gray_box._black_box import identify_continuous as identify_continuous
from lpvid.identify.gray_box._filters import AbstractFilterBasis as AbstractFilterBasis
from lpvid.identify.gray_box._filters import FilterPowers as FilterPowers
from lpvid.identify.gray_box._filters import LaguerreFilters as LaguerreFilters
from lpvid.identify.gray_box._mechanical import MechanicalFit as MechanicalFit
from lpvid.identify.gray_box._mechanical import identify_mechanical as identify_mechanical
from lpvid.identify.gray_box._methods import (
    AbstractContinuousTimeMethod as AbstractContinuousTimeMethod,
)
from lpvid.identify.gray_box._methods import ContinuousTimeCVA as ContinuousTimeCVA
from lpvid.identify.gray_box._methods import ContinuousTimeMOESP as ContinuousTimeMOESP
from lpvid.identify.gray_box._methods import ContinuousTimeN4SID as ContinuousTimeN4SID
from lpvid.identify.gray_box._search import FilterSearch as FilterSearch
