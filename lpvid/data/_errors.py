"""The error that readers raise."""


class DataError(ValueError):
    """A file or table cannot become `IOData`; the message names file, column, line and remedy.

    Example:
        >>> from lpvid.data import DataError, read_csv
        >>> try:
        ...     read_csv("missing.csv", inputs="u", outputs="y", dt=0.1)
        ... except DataError as error:
        ...     print(error)
        missing.csv: no such file; check the path and the working folder.
    """
