"""Training of the network of `lfpiv.calibration.network` on samples of a mapping (Eqs. 6-7).

`train` checks, splits and scales the samples, makes the first weights and judges the result on the test part; what lies
between is a trainer, one function of ``lfpiv.calibration.levenberg_marquardt``.

References
----------
.. [1] D. Nguyen and B. Widrow, "Improving the learning speed of 2-layer neural networks by choosing initial values of
       the adaptive weights", IJCNN 3, 21-26 (1990).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.calibration.levenberg_marquardt import Fit, Samples, Stop, levenberg_marquardt, normal_equations
from lfpiv.calibration.network import Network
from lfpiv.calibration.virtual_samples import Guide


@dataclass(frozen=True, kw_only=True, eq=False)
class Training:
    """What `train` returns. Lengths are in multiples of its argument `unit`."""

    network: Network
    """The network of the epoch with the lowest validation error."""
    training_rms: np.ndarray
    """Root mean square error of the training part before the first and after each epoch, shape (epoch + 1,)."""
    validation_rms: np.ndarray
    """The same of the validation part, shape (epoch + 1,)."""
    training_index: np.ndarray
    """Samples of the training part, ascending."""
    validation_index: np.ndarray
    """Samples of the validation part, ascending."""
    test_index: np.ndarray
    """Samples of the test part, ascending."""
    test_errors: np.ndarray
    """Distance between predicted and given output of each test sample, shape (n_test,)."""
    stop: Stop
    """Why training ended, and what to do about it."""
    shrinkage: float
    """Factor put on the network's output, 1 unless `train` was told to shrink."""
    seconds: float
    """Wall time of the training [s]."""

    @property
    def epochs(self) -> int:
        """Epochs run."""
        return self.training_rms.size - 1

    @property
    def sigma_nor(self) -> float:
        """Mean test error (Eq. 8, where `unit` was the microlens pitch)."""
        return float(self.test_errors.mean())


def first_layers(sizes: Sequence[int], training: Samples, rng: np.random.Generator) -> list[np.ndarray]:
    """First weights: hidden layers after Nguyen and Widrow ([1]_), the output layer by linear least squares on them."""
    layers = []
    for fan_in, nodes in pairwise(sizes[:-1]):
        reach = 0.7 * nodes ** (1 / fan_in)
        weight = rng.uniform(-1, 1, (fan_in, nodes))
        weight *= reach / np.linalg.norm(weight, axis=0)
        layers.append(np.vstack([weight, rng.uniform(-reach, reach, nodes)]))
    layers.append(np.zeros((sizes[-2] + 1, sizes[-1])))
    gram, gradient, _ = normal_equations(layers, training)
    size = layers[-1].size
    gram, gradient = gram[-size:, -size:], gradient[-size:]
    ridge = 1e-6 * np.trace(gram) / size  # keeps nearly equal hidden nodes from getting huge opposite weights
    layers[-1] = np.linalg.solve(gram + ridge * np.eye(size), gradient).reshape(layers[-1].shape)
    return layers


def split_samples(
    count: int,
    *,
    parts: tuple[float, float, float] = (0.70, 0.15, 0.15),
    groups: np.ndarray | None = None,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split samples at random into training, validation and test parts.

    Parameters
    ----------
    count : int
        Number of samples.
    parts : tuple of float
        Shares of the three parts; their sum is 1.
    groups : ndarray, shape (count,), optional
        Group of each sample, for example its board dot: a group is never divided between parts.
    rng : numpy.random.Generator
        Source of the random order.

    Returns
    -------
    tuple of ndarray
        Ascending sample numbers of the three parts.

    Raises
    ------
    ValueError
        If the shares are no shares or a part would be empty.
    """
    if len(parts) != 3 or min(parts) <= 0 or abs(sum(parts) - 1) > 1e-9:
        raise ValueError(f"split: expected three positive shares with the sum 1, got {tuple(parts)}.")
    if groups is None:
        member = np.arange(count)
    else:
        groups = np.asarray(groups)
        if groups.shape != (count,):
            raise ValueError(f"groups: expected one group per sample, shape ({count},), got {groups.shape}.")
        member = np.unique(groups, return_inverse=True)[1].ravel()
    number = int(member.max()) + 1 if count else 0
    order = rng.permutation(number)
    size = np.bincount(member, minlength=number)[order]
    middle = (np.cumsum(size) - size / 2) / max(count, 1)  # a group goes where its middle falls
    part_of = np.empty(number, int)
    part_of[order] = np.searchsorted(np.cumsum(parts)[:2], middle)
    training, validation, test = (np.flatnonzero(part_of[member] == part) for part in range(3))
    if 0 in (training.size, validation.size, test.size):
        raise ValueError(
            f"split: {count} samples in {number} groups are too few for shares of {tuple(parts)}: a part would be "
            "empty; give more samples or groups."
        )
    return training, validation, test


def train(
    inputs: np.ndarray,
    outputs: np.ndarray,
    *,
    hidden: Sequence[int] = (20,),
    trainer: Callable[..., Fit] = levenberg_marquardt,
    epochs: int = 200,
    patience: int = 15,
    tolerance: float = 1e-3,
    split: tuple[float, float, float] = (0.70, 0.15, 0.15),
    groups: np.ndarray | None = None,
    std: np.ndarray | None = None,
    guide: Guide | None = None,
    shrink: bool = False,
    seed: int = 0,
    unit: float = 1.0,
) -> Training:
    """Train a network on samples of a mapping, Eqs. 6-7, and judge it on samples it has not seen.

    Parameters
    ----------
    inputs : array_like, shape (n, d)
        For one camera: object point and pupil position (x, y, z, u, v) [mm].
    outputs : array_like, shape (n, m)
        For one camera: position (s, t) on the microlens array [mm]. All outputs share one unit.
    hidden : sequence of int
        Nodes of each hidden layer, at least one layer.
    trainer : callable
        ``trainer(layers, training, validation, epochs=, patience=, tolerance=) -> Fit``.
    epochs, patience, tolerance
        See `levenberg_marquardt`.
    split : tuple of float
        Shares of the training, validation and test parts.
    groups : ndarray, shape (n,), optional
        Group of each sample, for example its board dot. Whole groups go to one part, so that the test part holds
        dots that training never saw.
    std : ndarray, shape (n,), optional
        Standard deviation of each sample's outputs; a sample counts by its inverse square in training and validation.
    guide : callable, optional
        Given the training part's indices, inputs and outputs of further samples for training alone, and the standard
        deviation of each: they must not know of the dots held out.
    shrink : bool
        The outputs are corrections to a baseline, such as the residual of a fitted thin lens, so that 0 is the safe
        answer: multiply the network by the factor, from 0 to 1, that fits the validation part best. A network that
        learned nothing but noise vanishes.
    seed : int
        Of the split and the first weights. Equal arguments give equal networks.
    unit : float
        Length in which errors are given, for example the microlens pitch [mm].

    Returns
    -------
    Training

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, or there are too few samples for the split.
    """
    began = time.perf_counter()
    inputs, outputs = np.asarray(inputs, float), np.asarray(outputs, float)
    hidden = tuple(int(nodes) for nodes in hidden)
    _check(inputs, outputs, hidden, std, unit)
    rng = np.random.default_rng(seed)
    parts = split_samples(len(inputs), parts=split, groups=groups, rng=rng)
    centre, scale = _unit_range(inputs[parts[0]])
    output_centre, output_scale = _unit_range(outputs[parts[0]])
    output_scale = np.full_like(output_scale, output_scale.max())  # one unit, one scale: the loss is Eq. 8's distance
    weights = np.ones(len(inputs)) if std is None else 1 / np.asarray(std, float)

    def samples(index: np.ndarray) -> Samples:
        root_mean_square = np.sqrt(np.mean(weights[index] ** 2))
        return Samples(
            inputs=(inputs[index] - centre) / scale,
            outputs=(outputs[index] - output_centre) / output_scale,
            weights=(weights[index] / root_mean_square)[:, None],
        )

    training, validation = samples(parts[0]), samples(parts[1])
    if guide is not None:
        further, told, known = guide(parts[0])
        weight = (1 / known / np.sqrt(np.mean(weights[parts[0]] ** 2)))[:, None]
        training = Samples(
            inputs=np.vstack([training.inputs, (further - centre) / scale]),
            outputs=np.vstack([training.outputs, (told - output_centre) / output_scale]),
            weights=np.vstack([training.weights, weight]),
        )
    sizes = (inputs.shape[1], *hidden, outputs.shape[1])
    # BLAS on one thread: the trainers thread by blocks of samples, and on a shared machine BLAS's own spinning threads
    # make small products up to a hundred times slower.
    with threadpool_limits(limits=1, user_api="blas"):
        first = first_layers(sizes, training, rng)
        fit = trainer(first, training, validation, epochs=epochs, patience=patience, tolerance=tolerance)
    network = Network(
        weights=tuple(layer[:-1].copy() for layer in fit.layers),
        biases=tuple(layer[-1].copy() for layer in fit.layers),
        input_centre=centre,
        input_scale=scale,
        output_centre=output_centre,
        output_scale=output_scale,
    )
    shrinkage = 1.0
    if shrink:
        predicted = weights[parts[1], None] ** 2 * network(inputs[parts[1]])
        power = np.vdot(predicted, network(inputs[parts[1]]))
        shrinkage = float(np.clip(np.vdot(predicted, outputs[parts[1]]) / power, 0, 1)) if power > 0 else 0.0
        network = replace(network, output_centre=shrinkage * output_centre, output_scale=shrinkage * output_scale)
    test = parts[2]
    return Training(
        network=network,
        training_rms=np.array(fit.training_rms) * output_scale[0] / unit,
        validation_rms=np.array(fit.validation_rms) * output_scale[0] / unit,
        training_index=parts[0],
        validation_index=parts[1],
        test_index=test,
        test_errors=np.linalg.norm(network(inputs[test]) - outputs[test], axis=1) / unit,
        stop=fit.stop,
        shrinkage=shrinkage,
        seconds=time.perf_counter() - began,
    )


def _check(
    inputs: np.ndarray, outputs: np.ndarray, hidden: tuple[int, ...], std: np.ndarray | None, unit: float
) -> None:
    if inputs.ndim != 2 or outputs.ndim != 2 or len(inputs) != len(outputs) or 0 in inputs.shape + outputs.shape:
        raise ValueError(
            f"inputs, outputs: expected shapes (n, d) and (n, m) with one row per sample, got {inputs.shape} and "
            f"{outputs.shape}."
        )
    for name, array in (("inputs", inputs), ("outputs", outputs)):
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        if bad:
            raise ValueError(f"{name}: expected finite values, {bad} of {len(array)} samples are not; leave them out.")
    if not hidden or min(hidden) < 1:
        raise ValueError(f"hidden: expected the nodes of at least one hidden layer, each >= 1, got {hidden}.")
    if std is not None:
        std = np.asarray(std, float)
        if std.shape != (len(inputs),) or not (np.isfinite(std) & (std > 0)).all():
            raise ValueError(f"std: expected {len(inputs)} positive finite values, got shape {std.shape}.")
    if not unit > 0:
        raise ValueError(f"unit: expected a positive length, got {unit}.")


def _unit_range(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half range of each column; a constant column gets the scale 1."""
    low, high = values.min(axis=0), values.max(axis=0)
    half = (high - low) / 2
    return (low + high) / 2, np.where(half > 0, half, 1.0)
