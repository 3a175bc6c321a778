"""The command line: `lpvid …`, or `python -m lpvid …`."""

import sys

from lpvid.commands import main

if __name__ == "__main__":
    sys.exit(main())
