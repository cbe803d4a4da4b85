"""Means and fluctuations over pairs: public name of `lfpiv.velocity.statistics`."""

import sys

from lfpiv.velocity import statistics

sys.modules[__name__] = statistics
