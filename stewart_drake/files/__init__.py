"""Files: read up to a limit and strictly, written whole or not at all.

The argument `expected` of a reader describes the file; every message ends with it.
"""
