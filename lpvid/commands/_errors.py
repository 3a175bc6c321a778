"""What is the user's to mend."""


class UsageError(ValueError):
    """Wrong use of the command line: one line on stderr, exit code 2."""
