"""Models of fewer states: balanced truncation with its error bound."""

from lpvid.reduce._balanced_truncation import Reduction as Reduction
from lpvid.reduce._balanced_truncation import balanced_truncation as balanced_truncation
from lpvid.reduce._hankel import hankel_singular_values as hankel_singular_values
