"""Trainers of feedforward networks; a trainer is one function ``(layers, training, validation, **settings) -> Fit``.

Layers are matrices (inputs + 1, nodes) whose last row is the bias; hidden layers are tanh, the last one is linear.

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
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

BLOCK_BYTES = 1 << 20
"""Memory of one block of Jacobian rows: large enough for BLAS, small enough to stay in the cache."""
LEAST_ROWS = 512
"""Samples in a block at least, so that adding products up costs little beside making them."""
RANGES = 8
"""Ranges of samples that are summed separately. Fixed, so that results do not depend on the number of threads."""
LEAST_DAMPING, FIRST_DAMPING, LAST_DAMPING = 1e-15, 1e-3, 1e12
"""Damping below which it has no effect, of the first step, and where a step is too short to matter; relative to the
diagonal of J^T J."""
LONGEST_CORRECTION = 0.375
"""Second-order correction above which a step is not trusted, as a share of the step ([3]_: 2 |a| / |v| <= 0.75)."""


Terms = tuple[np.ndarray, ...]
"""Arrays to be summed over the samples."""


class Stop(enum.Enum):
    """Why training ended; the text is the advice."""

    VALIDATION = "the validation error no longer falls; the best epoch was kept"
    MINIMUM = "no step lowers the training error any more; this is a minimum of the training error"
    EPOCH_LIMIT = "epoch limit reached while the validation error still fell: raise network.epochs"


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """Scaled samples as a trainer sees them."""

    inputs: np.ndarray
    """Shape (n, d), within [-1, 1]."""
    outputs: np.ndarray
    """Shape (n, m)."""
    weights: np.ndarray
    """Factor of each sample's residual, shape (n, 1); mean square 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """What a trainer returns: layers and rms errors in scaled units."""

    layers: list[np.ndarray]
    training_rms: list[float]
    validation_rms: list[float]
    stop: Stop


def forward(layers: Sequence[np.ndarray], inputs: np.ndarray) -> list[np.ndarray]:
    """Return the outputs of every layer; the last one is linear."""
    outputs = []
    for layer in layers:
        inputs = inputs @ layer[:-1] + layer[-1]
        if layer is not layers[-1]:
            np.tanh(inputs, out=inputs)
        outputs.append(inputs)
    return outputs


def _add_up(job: Callable[[int, int], Terms], size: int, rows: int) -> Terms:
    """Sum of ``job(first, last)``, a tuple of arrays, over blocks of `rows` samples, on the cores of this process.

    The samples are cut into a fixed number of ranges, each summed by one thread, and the ranges are added in order: the
    result does not depend on the number of threads. BLAS should run on one thread meanwhile (`train` sees to that).
    """

    def add_range(edge: tuple[int, int]) -> Terms:
        total = job(edge[0], min(edge[0] + rows, edge[1]))
        for first in range(edge[0] + rows, edge[1], rows):
            for a, b in zip(total, job(first, min(first + rows, edge[1])), strict=True):
                a += b
        return total

    edges = [size * part // RANGES for part in range(RANGES + 1)]
    with ThreadPoolExecutor(_cores()) as pool:
        totals = list(pool.map(add_range, [edge for edge in pairwise(edges) if edge[0] < edge[1]]))
    return tuple(sum(terms[1:], terms[0]) for terms in zip(*totals, strict=True))


def _sum_of_squares(layers: Sequence[np.ndarray], samples: Samples) -> float:
    """Weighted sum of squared residuals."""

    def squares(first: int, last: int) -> Terms:
        part = slice(first, last)
        residual = samples.weights[part] * (samples.outputs[part] - forward(layers, samples.inputs[part])[-1])
        return (np.vdot(residual, residual).reshape(1),)

    widest = max(layer.shape[1] for layer in layers)
    return float(_add_up(squares, len(samples.inputs), max(LEAST_ROWS, BLOCK_BYTES // (8 * 2 * widest)))[0][0])


def normal_equations(layers: list[np.ndarray], samples: Samples) -> tuple[np.ndarray, np.ndarray, float]:
    """J^T J, J^T e and e^T e of the residuals e = weight (outputs - network) by backpropagation ([1]_).

    J is the derivative of the network's weighted outputs by the parameters: all layers of `layers`, each flattened in
    C order, one after the other. The rows of J that belong to one sample share most of their factors: the last hidden
    layer's columns are, for output o, ``W[j, o]`` times columns ``(1 - h_j^2) a_i`` that do not depend on o, and the
    output layer's columns are the hidden outputs themselves. So these two layers enter the products once per sample,
    not once per output, and J is never stored: blocks of samples are summed up.

    Returns
    -------
    tuple
        ``(gram (p, p), gradient (p,), sum of squares)`` for p parameters.
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
    squares, shared, shared_gradient, *rest = _add_up(products, len(samples.inputs), rows)

    # Unfold the shared products: parameter (i, j) of the last hidden layer, parameter (k, o) of the output layer.
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


def _bending(layers: Sequence[np.ndarray], steps: Sequence[np.ndarray], samples: Samples) -> np.ndarray:
    """J^T f'' for the second derivative f'' of the weighted outputs along a step of the layers, exactly."""

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
    return _add_up(products, len(samples.inputs), max(LEAST_ROWS, BLOCK_BYTES // (8 * 4 * widest)))[0]


def levenberg_marquardt(
    layers: list[np.ndarray],
    training: Samples,
    validation: Samples,
    *,
    epochs: int,
    patience: int,
    tolerance: float,
) -> Fit:
    """Train by Levenberg-Marquardt with geodesic acceleration and early stopping.

    The step solves (J^T J + damping D) step = J^T e ([1]_) with Marquardt's scaling, D the largest diagonal of J^T J
    so far; the second-order correction along it ([3]_) follows the narrow curved valleys of a network's error and
    takes about a fifth of the epochs of plain Levenberg-Marquardt. Damping follows the gain ratio ([2]_).

    Parameters
    ----------
    layers : list of ndarray
        First weights, each (inputs + 1, nodes) with the bias in the last row.
    training, validation : Samples
        Scaled samples; the second part only decides when to stop and which epoch is kept.
    epochs : int
        Accepted steps at most.
    patience : int
        Training stops when the lowest validation error has fallen by less than `tolerance` in so many epochs.
    tolerance : float
        Relative fall of the validation error that counts.
    """
    shapes = [layer.shape for layer in layers]
    edges = np.cumsum([layer.size for layer in layers])[:-1]
    theta = np.concatenate([layer.ravel() for layer in layers])

    def unpack(vector: np.ndarray) -> list[np.ndarray]:
        return [part.reshape(shape) for part, shape in zip(np.split(vector, edges), shapes, strict=True)]

    def validation_error(vector: np.ndarray) -> float:
        return math.sqrt(_sum_of_squares(unpack(vector), validation) / validation.outputs.size)

    gram, gradient, squares = normal_equations(layers, training)
    training_rms, validation_rms = [np.sqrt(squares / training.outputs.size)], [validation_error(theta)]
    best, best_theta, mark, mark_epoch = validation_rms[0], theta, validation_rms[0], 0
    damping, growth, scale = FIRST_DAMPING, 2.0, np.zeros(theta.size)
    stop = Stop.EPOCH_LIMIT
    while len(training_rms) <= epochs:
        scale = np.maximum(scale, gram.diagonal())
        scale = np.maximum(scale, 1e-12 * scale.max())  # dead nodes have no derivative
        while damping < LAST_DAMPING:  # until a step lowers the error
            trial = np.inf
            try:
                factor = cho_factor(gram + np.diag(damping * scale), overwrite_a=True, check_finite=False)
            except LinAlgError:
                factor = None
            if factor is not None:
                step = cho_solve(factor, gradient, check_finite=False)
                correction = -0.5 * cho_solve(
                    factor, _bending(unpack(theta), unpack(step), training), check_finite=False
                )
                if correction @ (scale * correction) <= LONGEST_CORRECTION**2 * (step @ (scale * step)):
                    trial = _sum_of_squares(unpack(theta + step + correction), training)
            if trial < squares:
                gain = (squares - trial) / (step @ (damping * scale * step + gradient))
                damping, growth = max(damping * max(0.1, 1 - (2 * gain - 1) ** 3), LEAST_DAMPING), 2.0
                break
            damping, growth = damping * growth, growth * 2
        else:
            stop = Stop.MINIMUM
            break
        theta = theta + step + correction
        gram, gradient, squares = normal_equations(unpack(theta), training)
        training_rms.append(np.sqrt(squares / training.outputs.size))
        validation_rms.append(validation_error(theta))
        if validation_rms[-1] < best:
            best, best_theta = validation_rms[-1], theta
        if best < mark * (1 - tolerance):
            mark, mark_epoch = best, len(training_rms) - 1
        elif len(training_rms) - 1 - mark_epoch >= patience:
            stop = Stop.VALIDATION
            break
    return Fit(layers=unpack(best_theta), training_rms=training_rms, validation_rms=validation_rms, stop=stop)


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
