"""Records and where they come from: `IOData`, preprocessing that can be undone, readers."""

from lpvid.data._errors import DataError as DataError
from lpvid.data._io_data import IOData as IOData
from lpvid.data._io_data import join as join
