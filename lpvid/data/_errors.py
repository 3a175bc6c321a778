"""The error that readers raise."""


class DataError(ValueError):
    """A file or table cannot become `IOData`; the message names file, column, line and remedy."""
