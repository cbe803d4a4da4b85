"""Levenberg-Marquardt training of feedforward networks with tanh hidden layers and a linear output layer.

A trainer takes first layers and scaled samples and returns a `Fit`. A layer is a matrix (inputs + 1, nodes) with the
biases in the last row. With the weighted residuals e and their negative Jacobian J, a step solves
(J^T J + damping D) step = J^T e ([1]_). The gain ratio sets the damping ([2]_), and geodesic acceleration adds a
second-order correction ([3]_).

References
----------
.. [1] M. T. Hagan and M. B. Menhaj, "Training feedforward networks with the Marquardt algorithm", IEEE Trans. Neural
       Networks 5, 989-993 (1994).
.. [2] K. Madsen, H. B. Nielsen and O. Tingleff, "Methods for non-linear least squares problems", DTU (2004).
.. [3] M. K. Transtrum and J. P. Sethna, "Improvements to the Levenberg-Marquardt algorithm for nonlinear least-squares
       minimization", arXiv:1201.5885 (2012).
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from lfpiv_kernels.runtime import cores

FEWEST_SHARED = 5000
"""Sum fewer samples by one thread: starting threads takes longer."""
BLOCK_BYTES = 1 << 20
"""Memory of one block of Jacobian rows [byte]."""
LEAST_ROWS = 512
"""Least number of samples in a block."""
RANGES = 8
"""Ranges of samples that are summed in parallel. Fixed, so that results do not depend on the number of threads."""
LEAST_DAMPING, FIRST_DAMPING, LAST_DAMPING = 1e-15, 1e-3, 1e12
"""Least damping, damping of the first step, and damping that ends the search for a step, relative to D."""
LONGEST_CORRECTION = 0.375
"""Largest second-order correction of an accepted step, relative to the step. [3]_ demands 2 |a| / |v| <= 0.75."""
LEAST_SCALE = 1e-12
"""Lower limit of D's diagonal, relative to its largest element. Parameters of dead nodes have no derivative."""

Terms = tuple[np.ndarray, ...]
"""Arrays to be summed over the samples."""


class TrainingStop(enum.Enum):
    """Reason why training ended. The text is the advice."""

    VALIDATION = "the validation error no longer falls; the best epoch was kept"
    MINIMUM = "no step lowers the training error any more; this is a minimum of the training error"
    EPOCH_LIMIT = "epoch limit reached while the validation error still fell: raise network.epochs"


@dataclass(frozen=True, kw_only=True)
class TrainingRules:
    """Rules that end a training."""

    epochs: int = 200
    """Largest number of epochs."""
    patience: int = 15
    """Epochs without a fall of the validation error after which training stops."""
    tolerance: float = 1e-3
    """Relative fall of the validation error that counts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Scaled samples of a trainer."""

    inputs: np.ndarray
    """Shape (n, d), within [-1, 1]."""
    outputs: np.ndarray
    """Shape (n, m)."""
    weights: np.ndarray
    """Factor on the residual of each sample, shape (n, 1)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """Result of a trainer. Errors are in scaled units."""

    layers: list[np.ndarray]
    """Trained layers."""
    training_rms: list[float]
    """Error of the training part before the first and after each epoch."""
    validation_rms: list[float]
    """Error of the validation part."""
    stop: TrainingStop
    """Reason why training ended."""


Trainer = Callable[[list[np.ndarray], Samples, Samples, TrainingRules], Fit]
"""Train first layers on scaled samples: ``trainer(layers, training, validation, rules)``."""


def levenberg_marquardt(layers: list[np.ndarray], training: Samples, validation: Samples, rules: TrainingRules) -> Fit:
    """Train by Levenberg-Marquardt with geodesic acceleration and early stopping.

    D is the largest diagonal of J^T J so far (Marquardt's scaling).

    Parameters
    ----------
    layers : list of ndarray
        First layers.
    training, validation : Samples
        Scaled samples. The validation part decides when to stop and which epoch is returned.
    rules : TrainingRules
        Rules that end the training. An epoch is an accepted step.

    Returns
    -------
    Fit
        Holds the layers of the epoch with the lowest validation error.
    """
    unpack = unpacker(layers)
    theta = flattened(layers)
    gram, gradient, squares = normal_equations(layers, training)
    training_rms, validation_rms = [math.sqrt(squares / training.outputs.size)], [_rms_error(layers, validation)]
    best, best_theta, mark, mark_epoch = validation_rms[0], theta, validation_rms[0], 0
    damping, growth, scale = FIRST_DAMPING, 2.0, np.zeros(theta.size)
    stop = TrainingStop.EPOCH_LIMIT
    while len(training_rms) <= rules.epochs:
        scale = np.maximum(scale, gram.diagonal())
        scale = np.maximum(scale, LEAST_SCALE * scale.max())
        while damping < LAST_DAMPING:
            trial = np.inf
            if (steps := _steps(unpack, theta, training, gram + np.diag(damping * scale), gradient)) is not None:
                step, correction = steps
                if correction @ (scale * correction) <= LONGEST_CORRECTION**2 * (step @ (scale * step)):
                    trial = _sum_of_squares(unpack(theta + step + correction), training)
            if trial < squares:
                gain = (squares - trial) / (step @ (damping * scale * step + gradient))
                damping, growth = max(damping * max(0.1, 1 - (2 * gain - 1) ** 3), LEAST_DAMPING), 2.0
                break
            damping, growth = damping * growth, growth * 2
        else:
            stop = TrainingStop.MINIMUM
            break
        theta = theta + step + correction
        gram, gradient, squares = normal_equations(unpack(theta), training)
        training_rms.append(math.sqrt(squares / training.outputs.size))
        validation_rms.append(_rms_error(unpack(theta), validation))
        if validation_rms[-1] < best:
            best, best_theta = validation_rms[-1], theta
        if best < mark * (1 - rules.tolerance):
            mark, mark_epoch = best, len(training_rms) - 1
        elif len(training_rms) - 1 - mark_epoch >= rules.patience:
            stop = TrainingStop.VALIDATION
            break
    return Fit(layers=unpack(best_theta), training_rms=training_rms, validation_rms=validation_rms, stop=stop)


def flattened(layers: Sequence[np.ndarray]) -> np.ndarray:
    """Return the parameters of all layers as one vector."""
    return np.concatenate([layer.ravel() for layer in layers])


def unpacker(layers: Sequence[np.ndarray]) -> Callable[[np.ndarray], list[np.ndarray]]:
    """Return the function that cuts one vector of parameters into layers of these shapes."""
    shapes, edges = [layer.shape for layer in layers], np.cumsum([layer.size for layer in layers])[:-1]

    def unpack(vector: np.ndarray) -> list[np.ndarray]:
        return [part.reshape(shape) for part, shape in zip(np.split(vector, edges), shapes, strict=True)]

    return unpack


def _steps(
    unpack: Callable[[np.ndarray], list[np.ndarray]],
    theta: np.ndarray,
    training: Samples,
    damped: np.ndarray,
    gradient: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the first-order step and its second-order correction, or None where `damped` is not positive definite."""
    try:
        factor = cho_factor(damped, overwrite_a=True, check_finite=False)
    except LinAlgError:
        return None
    step = cho_solve(factor, gradient, check_finite=False)
    bend = second_order_gradient(unpack(theta), unpack(step), training)
    return step, -0.5 * cho_solve(factor, bend, check_finite=False)


def _rms_error(layers: Sequence[np.ndarray], samples: Samples) -> float:
    return math.sqrt(_sum_of_squares(layers, samples) / samples.outputs.size)


def forward(layers: Sequence[np.ndarray], inputs: np.ndarray) -> list[np.ndarray]:
    """Return the outputs of every layer; the last one is linear."""
    outputs = []
    for layer in layers:
        inputs = inputs @ layer[:-1] + layer[-1]
        if layer is not layers[-1]:
            np.tanh(inputs, out=inputs)
        outputs.append(inputs)
    return outputs


def _sum_over_blocks(terms_of: Callable[[int, int], Terms], count: int, rows: int) -> Terms:
    """Return the sum of ``terms_of(first, last)`` over blocks of `rows` samples, many samples by several threads.

    Each of a fixed number of ranges is summed by one thread, and the ranges are added in order. So the result does not
    depend on the number of threads. The caller limits BLAS to one thread.
    """

    def add_range(edge: tuple[int, int]) -> Terms:
        total = terms_of(edge[0], min(edge[0] + rows, edge[1]))
        for first in range(edge[0] + rows, edge[1], rows):
            for a, b in zip(total, terms_of(first, min(first + rows, edge[1])), strict=True):
                a += b
        return total

    edges = [count * part // RANGES for part in range(RANGES + 1)]
    ranges = [edge for edge in pairwise(edges) if edge[0] < edge[1]]
    if count < FEWEST_SHARED:
        totals = list(map(add_range, ranges))
    else:
        with ThreadPoolExecutor(cores()) as pool:
            totals = list(pool.map(add_range, ranges))
    return tuple(sum(terms[1:], terms[0]) for terms in zip(*totals, strict=True))


def _sum_of_squares(layers: Sequence[np.ndarray], samples: Samples) -> float:
    def squares(first: int, last: int) -> Terms:
        part = slice(first, last)
        residual = samples.weights[part] * (samples.outputs[part] - forward(layers, samples.inputs[part])[-1])
        return (np.vdot(residual, residual).reshape(1),)

    widest = max(layer.shape[1] for layer in layers)
    return float(_sum_over_blocks(squares, len(samples.inputs), max(LEAST_ROWS, BLOCK_BYTES // (8 * 2 * widest)))[0][0])


def normal_equations(layers: list[np.ndarray], samples: Samples) -> tuple[np.ndarray, np.ndarray, float]:
    """Return J^T J, J^T e and e^T e of the residuals e = weight (outputs - network) by backpropagation ([1]_).

    J is the derivative of the network's weighted outputs by the parameters: all layers, each flattened in C order, one
    after the other. J is never stored. The last hidden layer's columns of J are, for output o, ``W[j, o]`` times
    columns ``(1 - h_j^2) a_i`` that do not depend on o, and the output layer's columns are the hidden outputs. So these
    two layers enter the products once per sample instead of once per output.

    Returns
    -------
    gram : ndarray, shape (p, p)
        J^T J of p parameters.
    gradient : ndarray, shape (p,)
        J^T e.
    squares : float
        e^T e.
    """
    output_layer = layers[-1][:-1]
    nodes, outputs = output_layer.shape
    deep_size = sum(layer.size for layer in layers[:-2])
    hidden_size = layers[-2].size
    shared_size = hidden_size + nodes + 1

    def products(first: int, last: int) -> Terms:
        inputs, weight = samples.inputs[first:last], samples.weights[first:last]
        count = len(weight)
        activations = forward(layers, inputs)
        ones = np.ones((count, 1))
        fed = [np.hstack([array, ones]) for array in (inputs, *activations[:-1])]  # the bias sees an input of 1
        slopes = [1 - array**2 for array in activations[:-1]]
        residual = weight * (samples.outputs[first:last] - activations[-1])
        shared = np.empty((count, shared_size))
        block = shared[:, :hidden_size].reshape(count, -1, nodes)
        np.multiply(fed[-2][:, :, None], (weight * slopes[-1])[:, None, :], out=block)
        np.multiply(weight, fed[-1], out=shared[:, hidden_size:])
        sums = [np.vdot(residual, residual).reshape(1), shared.T @ shared, shared.T @ residual]
        if deep_size:
            deep = np.empty((count, outputs, deep_size))
            delta = slopes[-1][:, None, :] * output_layer.T * weight[:, :, None]  # (sample, output, node)
            end = deep_size
            for number in range(len(layers) - 3, -1, -1):
                size, width = layers[number].size, layers[number].shape[1]
                delta = (delta.reshape(count * outputs, -1) @ layers[number + 1][:-1].T).reshape(count, outputs, width)
                delta *= slopes[number][:, None, :]
                products_out = deep[:, :, end - size : end].reshape(count, outputs, -1, width)
                np.multiply(fed[number][:, None, :, None], delta[:, :, None, :], out=products_out)
                end -= size
            flat = deep.reshape(count * outputs, deep_size)
            sums += [flat.T @ flat, flat.T @ residual.ravel()]
            sums.append(np.stack([deep[:, output].T @ shared for output in range(outputs)]))
        return tuple(sums)

    rows = max(LEAST_ROWS, BLOCK_BYTES // (8 * (shared_size + outputs * deep_size)))
    squares, shared, shared_gradient, *rest = _sum_over_blocks(products, len(samples.inputs), rows)

    # Expand the shared products to parameters (i, j) of the last hidden layer and (k, o) of the output layer.
    fan_in = layers[-2].shape[0]
    size = deep_size + hidden_size + layers[-1].size
    gram, gradient = np.empty((size, size)), np.empty(size)
    d, h, o = slice(deep_size), slice(deep_size, deep_size + hidden_size), slice(deep_size + hidden_size, size)
    block = shared[:hidden_size, :hidden_size].reshape(fan_in, nodes, fan_in, nodes)
    gram[h, h] = (block * (output_layer @ output_layer.T)[:, None, :]).reshape(hidden_size, hidden_size)
    block = shared[:hidden_size, hidden_size:].reshape(fan_in, nodes, nodes + 1, 1)
    gram[h, o] = (block * output_layer[:, None, :]).reshape(hidden_size, -1)
    gram[o, h] = gram[h, o].T
    gram[o, o] = np.kron(shared[hidden_size:, hidden_size:], np.eye(outputs))
    by_output = shared_gradient[:hidden_size].reshape(fan_in, nodes, outputs)
    gradient[h] = (by_output * output_layer).sum(axis=2).ravel()
    gradient[o] = shared_gradient[hidden_size:].ravel()
    if deep_size:
        gram[d, d], gradient[d], deep_shared = rest
        block = deep_shared[:, :, :hidden_size].reshape(outputs, deep_size, fan_in, nodes)
        gram[d, h] = np.einsum("opij,jo->pij", block, output_layer).reshape(deep_size, hidden_size)
        gram[d, o] = deep_shared[:, :, hidden_size:].transpose(1, 2, 0).reshape(deep_size, -1)
        gram[h, d], gram[o, d] = gram[d, h].T, gram[d, o].T
    return gram, gradient, float(squares[0])


def second_order_gradient(layers: Sequence[np.ndarray], steps: Sequence[np.ndarray], samples: Samples) -> np.ndarray:
    """Return J^T f'' for the second derivative f'' of the weighted outputs along a step of the layers, shape (p,)."""

    def products(first: int, last: int) -> Terms:
        weight = samples.weights[first:last]
        value = samples.inputs[first:last]
        velocity = acceleration = np.zeros((len(value), 0))  # derivatives of the layer's inputs along the step
        fed, slopes = [], []
        for number, (layer, step) in enumerate(zip(layers, steps, strict=True)):
            fed.append(value)
            matrix, turn = layer[:-1], step[:-1]
            sums = [value @ matrix + layer[-1], value @ turn + step[-1], 0.0]
            if number:
                sums[1] += velocity @ matrix
                sums[2] = acceleration @ matrix + 2 * (velocity @ turn)
            if number == len(layers) - 1:
                break
            value = np.tanh(sums[0])
            slopes.append(1 - value**2)
            velocity = slopes[-1] * sums[1]
            acceleration = slopes[-1] * sums[2] - 2 * value * velocity * sums[1]
        delta = weight**2 * sums[2]
        gradient: list[np.ndarray] = []
        for number in range(len(layers) - 1, -1, -1):
            gradient.insert(0, np.vstack([fed[number].T @ delta, delta.sum(axis=0)]).ravel())
            if number:
                delta = (delta @ layers[number][:-1].T) * slopes[number - 1]
        return (np.concatenate(gradient),)

    widest = max(layer.shape[1] for layer in layers)
    return _sum_over_blocks(products, len(samples.inputs), max(LEAST_ROWS, BLOCK_BYTES // (8 * 4 * widest)))[0]
