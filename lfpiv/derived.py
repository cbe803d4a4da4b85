"""Fields computed from velocity vectors: public name of `lfpiv.velocity.derived`."""

import sys

from lfpiv.velocity import derived

sys.modules[__name__] = derived
