"""Read images from files without a header of their own, whose layout the experiment file states."""

from __future__ import annotations

import numpy as np

from lfpiv.experiment.readers.source import CannotRead, ImagePath, Recorded
from lfpiv.experiment.readers.stack import Frames, read_bytes


class Raw(Frames):
    """Images one after the other behind a header, each in a block with bytes of known number before and behind it."""

    def __init__(self, image: ImagePath):
        layout = image.raw
        if layout is None:
            raise CannotRead(
                "expected the layout of a file without a header, found no table raw of its camera. State shape and "
                "dtype in [camera.raw]."
            )
        try:
            super().__init__(image.file, layout.shape, np.dtype(layout.dtype).newbyteorder(layout.byte_order), 0)
        except ValueError as error:
            raise CannotRead(f"expected images as [camera.raw] states them, but {error}. Correct its shape.") from None
        self._time, self._byte_order = layout.time, layout.byte_order
        self._start = layout.header_bytes + layout.frame_header_bytes
        self._length = layout.shape[0] * layout.shape[1] * self.dtype.itemsize
        self._first = layout.header_bytes
        self._step = layout.frame_header_bytes + self._length + layout.frame_footer_bytes
        self._count, rest = divmod(self.size - layout.header_bytes, self._step)
        if rest or self._count < 1:
            raise CannotRead(
                f"expected {layout.header_bytes} bytes and a multiple of {self._step} bytes, an image with its header "
                f"and footer, found {self.size} bytes. Correct [camera.raw], or copy the file again."
            )

    def place(self, number: int) -> tuple[int, int]:
        """Return first byte and number of bytes of an image's pixels."""
        return self._start + number * self._step, self._length

    def recorded(self, number: int) -> Recorded:
        """Return the time that an image's block states, after the first one of the file."""
        if self._time is None:
            return Recorded()
        found, first = self._stamp(number), self._stamp(0)
        return Recorded(
            time_s=float(found - first) * self._time.unit_s, uncertainty_s=2 * self._time.unit_s, is_arrival=True
        )

    def _stamp(self, number: int) -> int | float:
        assert self._time is not None
        dtype = np.dtype(self._time.dtype).newbyteorder(self._byte_order)
        start = self._first + number * self._step + self._time.at_byte
        return np.frombuffer(read_bytes(self.file, start, dtype.itemsize), dtype)[0].item()
