"""The command as `python -m stewart_drake`, where a shell does not find `stewart-drake`."""

import sys

from stewart_drake.cli import main

sys.exit(main())
