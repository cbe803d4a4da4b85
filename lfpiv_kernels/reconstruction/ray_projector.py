"""What all forms of a camera's weights share: voxels send light to rays, rays to pixels, and back."""

import contextlib
import threading
from collections.abc import Iterator

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.pixel_rays import ALL, RayMap, Rays
from lfpiv_kernels.transfer import Given, Values, empty, overwrite, to_device


class RayProjector:
    """The linear map of one camera's weights on the running device: voxels to sensor pixels, and back.

    Light goes from voxels to rays (`scatter`) and from rays to pixels; back from pixels to rays and from rays to voxels
    (`gather`). `project` and `back_project` may be called from several threads, which take turns. A caller of `scatter`
    and `gather` that needs the light on the rays in between calls them inside `reserved`.

    Arrays in and out are float32, C-contiguous and flat. Those of the device, and all on the CPU, are used in place.
    """

    @property
    def microimages(self) -> Rays:
        """Sensor pixel and share of each ray."""
        raise NotImplementedError

    map: RayMap
    """The map from rays to pixels."""
    rays: wp.array
    """The light on the rays after `scatter`."""
    returned: wp.array
    """The light on the rays that `gather` reads; it may be the memory of `rays`."""
    ray_sets: int
    """Sets of rays that can be taken alone."""

    rows = 1
    """Sets of rows of pixels under every lens that can be taken alone; 1 where the sets are of lenses."""
    form: str
    """Form of the weights, "profiles" or "pixels"."""
    parts: tuple[object, ...]
    """The dataclasses that it was made from."""
    nbytes: int
    """Memory of the weights [byte]."""

    @property
    def device_bytes(self) -> int:
        """Memory of the weights on a GPU, and of what projects with them [byte]; 0 on the CPU."""
        raise NotImplementedError

    def __init__(self) -> None:
        self._turn, self._reserved = threading.RLock(), False

    @contextlib.contextmanager
    def reserved(self) -> Iterator[None]:
        """Reserve the rays for this thread. Other threads wait.

        Raises
        ------
        RuntimeError
            If this thread has reserved them already: it would overwrite the light on them.
        """
        with self._turn:
            if self._reserved:
                raise RuntimeError(
                    "weights: these are in use by a reconstruction of the same thread, whose `progress` cannot project "
                    "with them. Do so before or after it, or build weights of its own."
                )
            self._reserved = True
            try:
                yield
            finally:
                self._reserved = False

    def scatter(self, volume: Values, ray_set: int = ALL) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of a set. Other rays may become dark or stay."""
        raise NotImplementedError

    def gather(self, out: Given, active: Values | None = None, ray_set: int = ALL) -> Given:
        """Add the weighted sum of the light on each voxel's rays of a set to `out`, shape (voxel,). Return `out`.

        Voxels whose `active`, shape (voxel,), float32, is zero may stay as they are.
        """
        raise NotImplementedError

    def darken(self, ray_set: int = ALL) -> None:
        """Set rays of a set to zero where the map from pixels writes none."""

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur several times."""
        raise NotImplementedError

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32."""
        raise NotImplementedError

    def largest_weight(self) -> float:
        """Return the largest weight of a ray."""
        raise NotImplementedError

    def project(self, volume: Values, out: Given, *ray_sets: int) -> Given:
        """Write the image of `volume`, shape (voxel,), by the rays of some sets to `out`, shape (pixel,). Return `out`.

        All rays count where no set is given.
        """
        with self.reserved():
            if ray_sets and ray_sets != (ALL,):
                self.rays.zero_()
            for ray_set in ray_sets or (ALL,):
                self.scatter(volume, ray_set)
            on_device = isinstance(out, wp.array)
            image = out if on_device else empty(out.size) if runtime.device().form == "gpu" else to_device(out, float)
            image.zero_()  # pixels that no voxel lights
            self.map.collect(self.rays, image)
        overwrite(out, image)
        return out

    def back_project(self, image: Values, out: Given, *ray_sets: int) -> Given:
        """Add the weighted sum of `image`, shape (pixel,), over each voxel's pixels to `out`, shape (voxel,).

        Only the rays of `ray_sets` count, all rays where no set is given. Return `out`.
        """
        with self.reserved():
            self.darken()
            self.map.spread(to_device(image, float), self.returned)
            for ray_set in ray_sets or (ALL,):
                self.gather(out, ray_set=ray_set)
        return out

    def exclusive_pixels(self, ray_set: int) -> np.ndarray:
        """Return the sensor pixels that see light by rays of one set and of no other one, shape (pixel,), int32."""
        rays = self.map.rays_of(ray_set)
        return self.map.pixel[rays.start : rays.end]
