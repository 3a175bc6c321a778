"""Refinement of models to the records: maximum likelihood, with its uncertainty."""

from lpvid.refinement._coordinates import Selection as Selection
from lpvid.refinement._coordinates import Ties as Ties
from lpvid.refinement._coordinates import matching as matching
from lpvid.refinement._coordinates import select as select
from lpvid.refinement._losses import AbstractLoss as AbstractLoss
from lpvid.refinement._losses import HuberLoss as HuberLoss
from lpvid.refinement._losses import SquaredLoss as SquaredLoss
from lpvid.refinement._predictors import AbstractPredictor as AbstractPredictor
from lpvid.refinement._predictors import Innovation as Innovation
from lpvid.refinement._predictors import OutputError as OutputError
from lpvid.refinement._profile import ProfileLikelihood as ProfileLikelihood
from lpvid.refinement._profile import profile_likelihood as profile_likelihood
from lpvid.refinement._refine import refine as refine
from lpvid.refinement._refined import Refined as Refined
