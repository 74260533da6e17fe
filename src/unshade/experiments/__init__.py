"""The paper's experiments and ours, each from raw data to a page: `unshade experiments`.

They can be stopped and run again: what is done stays in a journal, one row a picture, method and set of weights.
"""

from unshade.experiments.options import Options
from unshade.experiments.runner import Ran, run

__all__ = ["Options", "Ran", "run"]
