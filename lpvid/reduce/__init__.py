"""Models of fewer states: balanced and modal truncation, and what was lost made up for."""

from lpvid.reduce._balanced_truncation import Reduction as Reduction
from lpvid.reduce._balanced_truncation import balanced_truncation as balanced_truncation
from lpvid.reduce._hankel import hankel_singular_values as hankel_singular_values
from lpvid.reduce._modal_table import ModalTable as ModalTable
from lpvid.reduce._modal_table import modal_responses as modal_responses
from lpvid.reduce._modal_table import modal_table as modal_table
from lpvid.reduce._modal_truncation import ModalReduction as ModalReduction
from lpvid.reduce._modal_truncation import modal_truncation as modal_truncation
from lpvid.reduce._mode_ranks import AbstractModeRank as AbstractModeRank
from lpvid.reduce._mode_ranks import KnownFrequencies as KnownFrequencies
from lpvid.reduce._mode_ranks import ModalHankelValue as ModalHankelValue
from lpvid.reduce._mode_ranks import ModalResponseMagnitude as ModalResponseMagnitude
from lpvid.reduce._mode_ranks import ModeSingularValue as ModeSingularValue
from lpvid.reduce._update import AbstractUpdate as AbstractUpdate
from lpvid.reduce._update import InputUpdate as InputUpdate
from lpvid.reduce._update import OutputUpdate as OutputUpdate
from lpvid.reduce._update import UpdatedModel as UpdatedModel
from lpvid.reduce._update import update_model as update_model
