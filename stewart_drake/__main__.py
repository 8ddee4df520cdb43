"""The command, also as `python -m stewart_drake`, where a shell does not find `stewart-drake`."""

import signal
import sys


def run() -> int:
    """Run the command, which SIGTERM ends as Ctrl-C does, with 143 in place of 130.

    Until `main` handles them both end the process without a traceback.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:  # else it is ignored, as in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from stewart_drake.cli import main
    from stewart_drake.cli.common import INTERRUPTED, SIGNALS, TERMINATED, interrupt

    signal.signal(signal.SIGINT, handler)
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, interrupt)
    status = main()
    for number in (signal.SIGINT, signal.SIGTERM):  # at exit nothing catches an exception
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    return TERMINATED if status == INTERRUPTED and signal.SIGTERM in SIGNALS else status


if __name__ == "__main__":
    sys.exit(run())
