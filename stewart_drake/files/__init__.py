"""Files: read up to a limit and strictly, written whole or not at all."""
