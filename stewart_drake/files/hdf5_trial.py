"""Run as a script: reads all of a NetCDF file from stdin and ends, as `arrayio` describes.

Exit status 0 for a file that can be read; 1 for one that cannot, with the reason on stdout;
anything else where the HDF5 library ends the process or never comes to an end. Arguments: s of
computing, bytes that the arrays may need.
"""

import io
import math
import resource
import sys

_ROOM = 2_000_000_000
"""Bytes beside the arrays and the file: of Python and its libraries, most of it never touched."""


def main(seconds: int, most: int) -> int:
    """Reads every variable of the root group; the exit status."""
    raw = sys.stdin.buffer.read()
    memory = _ROOM + 2 * most + 2 * len(raw)
    for kind, limit in (
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        soft = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (soft, hard))
    try:
        import h5netcdf

        with h5netcdf.File(io.BytesIO(raw), "r") as file:
            variables = list(file.variables.values())
            if sum(math.prod(one.shape) * one.dtype.itemsize for one in variables) > most:
                raise ValueError(f"its arrays need more than {most // 1_000_000} MB")
            for one in (file, *variables):
                dict(one.attrs)
            for one in variables:
                one[...]
    # What is damaged shows as whatever the libraries trip over.
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        print(text if len(text) <= 120 else f"{text[:117]}...")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])))
