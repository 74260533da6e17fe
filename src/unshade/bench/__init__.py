"""The benchmark: data sets x methods, results as JSON, a table, a curve, and a sheet of the worst.

It can be stopped and run again: what is done stays in a journal, one row a picture and method.
"""

from unshade.bench.command import main
from unshade.bench.options import Options
from unshade.bench.runner import run

__all__ = ["Options", "main", "run"]
