"""Figures, tables, pages, the report, the replay, CSV, progress.

`stewart_drake.report` is this package and, called, the report on a scenario (`report.api.report`):
the name was given to both.
"""

import sys
from types import ModuleType
from typing import Any


class _Report(ModuleType):
    def __call__(self, *arguments: Any, **options: Any) -> Any:
        from stewart_drake.report.api import report

        return report(*arguments, **options)


sys.modules[__name__].__class__ = _Report
