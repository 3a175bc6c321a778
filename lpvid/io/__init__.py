"""Models to files and back: JSON, exact and complete; MATLAB, for use there."""

from lpvid.io._json import ModelFileError as ModelFileError
from lpvid.io._json import load as load
from lpvid.io._json import save as save
from lpvid.io._matlab import load_mat as load_mat
from lpvid.io._matlab import save_mat as save_mat
