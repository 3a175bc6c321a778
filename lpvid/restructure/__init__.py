"""Restructuring: black boxes into structured models by the H∞ norm of the difference."""

from lpvid.restructure._certificate import Certificate as Certificate
from lpvid.restructure._identifiability import Identifiability as Identifiability
from lpvid.restructure._identifiability import identifiability as identifiability
from lpvid.restructure._method import HinfMatching as HinfMatching
from lpvid.restructure._restructure import restructure as restructure
from lpvid.restructure._restructure import restructure_along as restructure_along
from lpvid.restructure._restructured import Restructured as Restructured
from lpvid.restructure._starts import AbstractStarts as AbstractStarts
from lpvid.restructure._starts import ClosedFormStart as ClosedFormStart
from lpvid.restructure._starts import LinearConditionsStart as LinearConditionsStart
from lpvid.restructure._starts import ScatteredStarts as ScatteredStarts
from lpvid.restructure._starts import SimilarityStarts as SimilarityStarts
