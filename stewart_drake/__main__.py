"""The command, also as `python -m stewart_drake`, where a shell does not find `stewart-drake`."""

import signal
import sys


def run() -> int:
    """Run the command. Until `main` handles Ctrl-C it ends the process without a traceback."""
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:  # else it is ignored, as in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from stewart_drake.cli import main

    signal.signal(signal.SIGINT, handler)
    return main()


if __name__ == "__main__":
    sys.exit(run())
