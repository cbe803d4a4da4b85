"""Change stored results as an older version, another program or a mistake would."""

import h5py

from lfpiv import hdf5


def rewrite(path, change, *, sealed=False):
    """Apply `change` to an HDF5 file; seal it again, or leave it as a program that knows no seals does."""
    with h5py.File(path, "r+") as file:
        change(file)
    if sealed:
        hdf5.seal(path)


def unseal(path, version=None):
    """Make a file one of an earlier version, which has no seal, no name and an earlier schema."""

    def older(file):
        for name in (hdf5.SEALED, "file"):
            if name in file.attrs:
                del file.attrs[name]
        if version is not None:
            file.attrs["schema_version"] = version

    rewrite(path, older)
