"""Train the network of a ray mapping (Eqs. 6-7) on labelled rays, and test it on rays it has not seen (Eq. 8).

`train` splits the samples into training, validation and test parts, scales them to [-1, 1], draws the first weights,
calls a trainer such as `levenberg_marquardt`, and measures the error on the test part.

References
----------
.. [1] D. Nguyen and B. Widrow, "Improving the learning speed of 2-layer neural networks by choosing initial values of
       the adaptive weights", IJCNN 3, 21-26 (1990).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.calibration.levenberg_marquardt import (
    Samples,
    Trainer,
    TrainingRules,
    TrainingStop,
    levenberg_marquardt,
    normal_equations,
)
from lfpiv.calibration.network import Network
from lfpiv.calibration.virtual_samples import VirtualSampler
from lfpiv.errors import InputError

FIRST_RIDGE = 1e-6
"""Ridge of the first output layer, relative to the mean diagonal of its normal equations."""


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(TrainingRules):
    """Size of a network and rules of its training."""

    hidden: tuple[int, ...] = (20,)
    """Nodes of each hidden layer."""
    trainer: Trainer = levenberg_marquardt
    """Method of the training."""
    split: tuple[float, float, float] = (0.70, 0.15, 0.15)
    """Shares of the training, validation and test parts."""
    shrink: bool = False
    """Multiply the network by the factor from 0 to 1 that fits the validation part best.

    For a network that corrects a baseline, such as a fitted thin lens. A correction that fits only noise becomes 0.
    """
    seed: int = 0
    """Seed of the split and the first weights. Equal seeds give equal networks."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """Ascending sample numbers of the three parts."""

    training: np.ndarray
    validation: np.ndarray
    test: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Training:
    """A trained network and its errors, in multiples of the `unit` given to `train`."""

    network: Network
    """The network of the epoch with the lowest validation error."""
    training_rms: np.ndarray
    """Root mean square error of the training part before the first and after each epoch, shape (epoch + 1,)."""
    validation_rms: np.ndarray
    """Root mean square error of the validation part, shape (epoch + 1,)."""
    split: Split
    """Samples of the training, validation and test parts."""
    test_errors: np.ndarray
    """Distance between predicted and given output of each test sample, shape (n_test,)."""
    stop: TrainingStop
    """Reason why training ended."""
    shrinkage: float
    """Factor on the network's output, 1 without `TrainingSettings.shrink`."""
    seconds: float
    """Wall time of the training [s]."""

    @property
    def epochs(self) -> int:
        """Number of epochs."""
        return self.training_rms.size - 1

    @property
    def sigma_nor(self) -> float:
        """Mean test error. Eq. 8 where `unit` is the microlens pitch."""
        return float(self.test_errors.mean())


def train(
    inputs: np.ndarray,
    outputs: np.ndarray,
    settings: TrainingSettings = TrainingSettings(),
    *,
    groups: np.ndarray | None = None,
    std: np.ndarray | None = None,
    virtual_samples: VirtualSampler | None = None,
    unit: float = 1.0,
) -> Training:
    """Train a network on samples of a mapping, Eqs. 6-7, and test it on samples it has not seen.

    Parameters
    ----------
    inputs : array_like, shape (n, d)
        For one camera: object point and pupil point (x, y, z, u, v) [mm].
    outputs : array_like, shape (n, m)
        For one camera: position (s, t) on the microlens array [mm]. All outputs share one unit.
    settings : TrainingSettings
        Size of the network and rules of the training.
    groups : ndarray, shape (n,), optional
        Group of each sample, for example its board dot. A group is never divided between parts.
    std : ndarray, shape (n,), optional
        Standard deviation of each sample's outputs. Its inverse square weights the sample.
    virtual_samples : callable, optional
        Makes additional training samples from the sample numbers of the training part, so that they cannot depend on
        the validation and test parts.
    unit : float
        Length in which errors are given, for example the microlens pitch [mm].

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, or there are too few samples for the split.
    """
    began = time.perf_counter()
    inputs, outputs = np.asarray(inputs, float), np.asarray(outputs, float)
    _check(inputs, outputs, settings.hidden, std, unit)
    rng = np.random.default_rng(settings.seed)
    split = split_samples(len(inputs), parts=settings.split, groups=groups, rng=rng)
    weights = np.ones(len(inputs)) if std is None else 1 / np.asarray(std, float)
    scaling = _Scaling.from_samples(inputs[split.training], outputs[split.training])
    training, validation = (
        scaling.samples(inputs[part], outputs[part], weights[part] / _rms(weights[part]))
        for part in (split.training, split.validation)
    )
    if virtual_samples is not None:
        virtual = virtual_samples(split.training)
        weight = 1 / virtual.std / _rms(weights[split.training])
        training = _joined(training, scaling.samples(virtual.inputs, virtual.outputs, weight))
    # BLAS runs on one thread because trainers already run blocks of samples in parallel.
    with threadpool_limits(limits=1, user_api="blas"):
        fit = settings.trainer(
            first_layers((inputs.shape[1], *settings.hidden, outputs.shape[1]), training, rng),
            training,
            validation,
            settings,
        )
    network, shrinkage = scaling.network(fit.layers), 1.0
    if settings.shrink:
        held = split.validation
        shrinkage = _best_factor(network(inputs[held]), outputs[held], weights[held])
        network = network.with_scaled_output(shrinkage)
    length = scaling.output_scale[0]
    return Training(
        network=network,
        training_rms=np.array(fit.training_rms) * length / unit,
        validation_rms=np.array(fit.validation_rms) * length / unit,
        split=split,
        test_errors=np.linalg.norm(network(inputs[split.test]) - outputs[split.test], axis=1) / unit,
        stop=fit.stop,
        shrinkage=shrinkage,
        seconds=time.perf_counter() - began,
    )


def split_samples(
    count: int,
    *,
    parts: tuple[float, float, float] = (0.70, 0.15, 0.15),
    groups: np.ndarray | None = None,
    rng: np.random.Generator,
) -> Split:
    """Split samples at random into training, validation and test parts.

    Parameters
    ----------
    count : int
        Number of samples.
    parts : tuple of float
        Shares of the three parts. Their sum is 1.
    groups : ndarray, shape (count,), optional
        Group of each sample, for example its board dot. A group is never divided between parts.
    rng : numpy.random.Generator
        Source of the random order.

    Raises
    ------
    ValueError
        If the shares are not positive with the sum 1, or a part would be empty.
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
    middle = (np.cumsum(size) - size / 2) / max(count, 1)  # the part that holds a group's middle takes the group
    part_of = np.empty(number, int)
    part_of[order] = np.searchsorted(np.cumsum(parts)[:2], middle)
    training, validation, test = (np.flatnonzero(part_of[member] == part) for part in range(3))
    if 0 in (training.size, validation.size, test.size):
        raise InputError(
            f"split: {count} samples in {number} groups are too few for shares of {tuple(parts)}: a part would be "
            "empty; give more samples or groups."
        )
    return Split(training=training, validation=validation, test=test)


def first_layers(sizes: Sequence[int], training: Samples, rng: np.random.Generator) -> list[np.ndarray]:
    """Draw the hidden layers after Nguyen and Widrow ([1]_) and fit the output layer to them by ridge regression."""
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
    ridge = FIRST_RIDGE * np.trace(gram) / size  # avoids huge opposite weights of nearly equal hidden nodes
    layers[-1] = np.linalg.solve(gram + ridge * np.eye(size), gradient).reshape(layers[-1].shape)
    return layers


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scaling:
    """Centre and half range of the training inputs and outputs. All outputs share one scale: the loss is a distance."""

    input_centre: np.ndarray
    input_scale: np.ndarray
    output_centre: np.ndarray
    output_scale: np.ndarray

    @classmethod
    def from_samples(cls, inputs: np.ndarray, outputs: np.ndarray) -> _Scaling:
        input_centre, input_scale = _centre_and_half_range(inputs)
        output_centre, output_scale = _centre_and_half_range(outputs)
        return cls(
            input_centre=input_centre,
            input_scale=input_scale,
            output_centre=output_centre,
            output_scale=np.full_like(output_scale, output_scale.max()),
        )

    def samples(self, inputs: np.ndarray, outputs: np.ndarray, weights: np.ndarray) -> Samples:
        return Samples(
            inputs=(inputs - self.input_centre) / self.input_scale,
            outputs=(outputs - self.output_centre) / self.output_scale,
            weights=weights[:, None],
        )

    def network(self, layers: Sequence[np.ndarray]) -> Network:
        return Network(
            weights=tuple(layer[:-1].copy() for layer in layers),
            biases=tuple(layer[-1].copy() for layer in layers),
            **vars(self),
        )


def _centre_and_half_range(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both per column. A constant column gets the half range 1."""
    low, high = values.min(axis=0), values.max(axis=0)
    half = (high - low) / 2
    return (low + high) / 2, np.where(half > 0, half, 1.0)


def _joined(first: Samples, second: Samples) -> Samples:
    return Samples(**{name: np.vstack([array, getattr(second, name)]) for name, array in vars(first).items()})


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _best_factor(predicted: np.ndarray, outputs: np.ndarray, weights: np.ndarray) -> float:
    """Return the factor from 0 to 1 on the prediction that gives the least weighted squared error."""
    weighted = weights[:, None] ** 2 * predicted
    power = np.vdot(weighted, predicted)
    return float(np.clip(np.vdot(weighted, outputs) / power, 0, 1)) if power > 0 else 0.0


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
