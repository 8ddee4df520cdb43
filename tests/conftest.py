"""What all tests need of the process they run in."""

import signal

from stewart_drake.report import terminal

# A shell that runs the tests in the background lets them ignore Ctrl-C, and the commands that they
# start would inherit that; those are tested for what they do on Ctrl-C.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What takes long on a busy machine tells on stderr how far it is, where tests expect nothing.
terminal.EVERY = 3600.0
