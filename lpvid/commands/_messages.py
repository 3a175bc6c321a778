"""What is said on stderr: one line each, in the command line's own words."""

import contextlib
import re
import sys
import types
import warnings
from collections.abc import Iterator

# The library speaks of its arguments; here they are options.
_WORDS = (
    (r"\bpass resample=True\b", "pass --resample"),
    (r"\bresample=True\b", "--resample"),
    (r"\bgive dt= instead of time=", "give --dt instead of --time"),
    (r"\bstabilise=(?=[\d.])", "--stabilise "),
    (r"\bblock_rows=(?=\d)", "--block-rows "),
    (r"\border=(?=\d)", "--order "),
    (r"\bsplit=(?=[\d.])", "--split "),
    (r"\btest=(?=\W|$)", "--test"),
    (r'\border="auto"', "--order auto"),
    (r"\bblock_rows\b", "--block-rows"),
    (r"\buse past outputs as instruments \(PastOutputMOESP\)", "use --method po-moesp"),
    (r"call the reader that fits, read_csv, read_mat or read_npz", "name it by its kind"),
    (r"data\.select\(inputs=\.\.\.\)", "another --input"),
    (r"data\.select\(outputs=\.\.\.\)", "another --output"),
)


def in_command_words(message: str) -> str:
    """A library message in one line, options in place of arguments."""
    for pattern, words in _WORDS:
        message = re.sub(pattern, words, message)
    return " ".join(message.split())


def say(message: str) -> None:
    """One line on stderr."""
    sys.stderr.write(" ".join(message.split()) + "\n")
    sys.stderr.flush()


class Warnings:
    """Collects the warnings raised within it and says each as one line, once."""

    def __init__(self, command: str):
        self.messages: list[str] = []
        self._subject = ""
        self._command = command
        self._catcher = warnings.catch_warnings()

    def __enter__(self) -> "Warnings":
        self._catcher.__enter__()
        warnings.resetwarnings()
        # What libraries say to programmers is none of the user's business.
        for category in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", category)
        warnings.filterwarnings("ignore", message=".*persistent compilation cache.*")
        warnings.simplefilter("always", UserWarning, append=True)
        warnings.simplefilter("always", RuntimeWarning, append=True)
        warnings.showwarning = self._show
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        self._catcher.__exit__(kind, error, trace)

    def _show(self, message, category, filename, lineno, file=None, line=None) -> None:
        del category, filename, lineno, file, line
        self.add(str(message))

    @contextlib.contextmanager
    def about(self, subject: str) -> Iterator[None]:
        """Warnings within begin with what they are about."""
        self._subject = f"{subject}: "
        try:
            yield
        finally:
            self._subject = ""

    def add(self, message: str) -> None:
        """Say a warning of the command's own."""
        text = self._subject + in_command_words(message)
        if text not in self.messages:
            self.messages.append(text)
            say(f"{self._command}: warning: {text}")
