"""The command line's commands: arguments in, library calls, tables and files out."""

from lpvid.commands._main import main as main
