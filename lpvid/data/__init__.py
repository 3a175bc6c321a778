"""Records and where they come from: `IOData`, preprocessing that can be undone, readers."""

from lpvid.data._csv import read_csv as read_csv
from lpvid.data._decimate import Decimate as Decimate
from lpvid.data._detrend import Detrend as Detrend
from lpvid.data._errors import DataError as DataError
from lpvid.data._io_data import IOData as IOData
from lpvid.data._join import join as join
from lpvid.data._lowpass import Lowpass as Lowpass
from lpvid.data._mat import read_mat as read_mat
from lpvid.data._npz import read_npz as read_npz
from lpvid.data._offset import Offset as Offset
from lpvid.data._pandas import from_pandas as from_pandas
from lpvid.data._periodic import PeriodicBand as PeriodicBand
from lpvid.data._preprocess import AbstractReversal as AbstractReversal
from lpvid.data._preprocess import AbstractStep as AbstractStep
from lpvid.data._preprocess import Undo as Undo
from lpvid.data._preprocess import preprocess as preprocess
from lpvid.data._read import read as read
from lpvid.data._scale import Scale as Scale
