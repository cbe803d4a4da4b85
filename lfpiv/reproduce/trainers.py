"""Train networks by the other trainers of Table 1: Bayesian regularisation, and gradient descent with momentum.

Both have the signature of `levenberg_marquardt` and go into `lfpiv.calibration.training.TrainingSettings.trainer`.

References
----------
.. [1] F. D. Foresee and M. T. Hagan, "Gauss-Newton approximation to Bayesian learning", ICNN 3, 1930-1935 (1997).
.. [2] D. J. C. MacKay, "Bayesian interpolation", Neural Computation 4, 415-447 (1992).
.. [3] B. T. Polyak, "Some methods of speeding up the convergence of iteration methods", USSR Comput. Math. Math.
       Phys. 4, 1-17 (1964).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, lapack

from lfpiv.calibration.levenberg_marquardt import (
    Fit,
    Samples,
    TrainingRules,
    TrainingStop,
    flattened,
    forward,
    normal_equations,
    unpacker,
)

FIRST_DAMPING, LEAST_DAMPING, LAST_DAMPING = 5e-3, 1e-20, 1e10
"""Damping of the first step, smallest damping, and damping at which training stops: the customary values for [1]_."""
MOMENTUM = 0.9
"""Momentum: share of the last step that is added to the next one."""
BATCH = 64
"""Samples of a batch."""
FIRST_RATE, LAST_RATE = 0.1, 1e-5
"""First learning rate, for the mean squared error in scaled units, and rate at which training ends."""
STALLED, SLOWER = 10, 0.5
"""Epochs without a lower validation error after which the rate falls, and its factor."""
LONGEST_GRADIENT = 1.0
"""Largest length of a gradient. Longer ones are cut."""


def bayesian_regularisation(
    layers: list[np.ndarray], training: Samples, validation: Samples, rules: TrainingRules
) -> Fit:
    """Train by Levenberg-Marquardt on beta E_D + alpha E_W, alpha and beta estimated from the data ([1]_, [2]_).

    E_D is the sum of squared errors, E_W that of the network's parameters. After each step alpha = gamma / 2 E_W and
    beta = (n - gamma) / 2 E_D, with gamma = p - alpha tr (beta J^T J + alpha I)^-1 the parameters that the data
    determine. The result is that of the last epoch. The validation part is only monitored.

    Parameters
    ----------
    layers : list of ndarray
        First weights, each (inputs + 1, nodes) with the bias in the last row.
    training, validation : Samples
        Scaled samples.
    rules : TrainingRules
        An epoch is an accepted step. Training stops when the training error has fallen by less than the fraction
        `tolerance` in `patience` epochs.
    """
    unpack = unpacker(layers)
    theta = flattened(layers)
    values = training.outputs.size
    gram, gradient, squares = normal_equations(layers, training)
    training_rms, validation_rms = [np.sqrt(squares / values)], [_rms(layers, validation)]
    gamma, damping, stop = float(theta.size), FIRST_DAMPING, TrainingStop.EPOCH_LIMIT
    alpha, beta = _hyperparameters(min(gamma, 0.9 * values), values, squares, theta)
    while len(training_rms) <= rules.epochs:
        objective = beta * squares + alpha * (theta @ theta)
        while damping < LAST_DAMPING:
            factor = _factor(beta * gram, alpha + damping)
            if factor is not None:
                trial = theta + cho_solve(factor, beta * gradient - alpha * theta, check_finite=False)
                trial_squares = _sum_of_squares(unpack(trial), training)
                if beta * trial_squares + alpha * (trial @ trial) < objective:
                    damping = max(damping / 10, LEAST_DAMPING)
                    break
            damping *= 10
        else:
            stop = TrainingStop.MINIMUM
            break
        theta = trial
        gram, gradient, squares = normal_equations(unpack(theta), training)
        factor = _factor(beta * gram, alpha)
        if factor is not None:
            inverse, failed = lapack.dpotri(factor[0], lower=factor[1])
            if not failed:
                gamma = float(np.clip(theta.size - alpha * np.trace(inverse), 0, 0.9 * values))
        alpha, beta = _hyperparameters(gamma, values, squares, theta)
        training_rms.append(np.sqrt(squares / values))
        validation_rms.append(_rms(unpack(theta), validation))
        patience = rules.patience
        if len(training_rms) > patience and training_rms[-1] > (1 - rules.tolerance) * training_rms[-1 - patience]:
            stop = TrainingStop.MINIMUM
            break
    return Fit(layers=unpack(theta), training_rms=training_rms, validation_rms=validation_rms, stop=stop)


def gradient_descent(layers: list[np.ndarray], training: Samples, validation: Samples, rules: TrainingRules) -> Fit:
    """Train by gradient descent with momentum ([3]_) on small batches of samples in random order.

    With the gradient of all samples, one step per epoch, deep networks hardly train in a thousand epochs. Batches give
    some hundred steps per epoch. The rate is halved where the validation error stalls.

    Parameters
    ----------
    layers, training, validation : as for `lfpiv.calibration.levenberg_marquardt.levenberg_marquardt`
        The result is the epoch with the lowest validation error.
    rules : TrainingRules
        Only the number of epochs is used. Training also stops when the rate has fallen to `LAST_RATE`.
    """
    unpack = unpacker(layers)
    theta = best_theta = flattened(layers)
    step, rate, stalled = np.zeros_like(theta), FIRST_RATE, 0
    training_rms, validation_rms = [_rms(layers, training)], [_rms(layers, validation)]
    best, stop = validation_rms[0], TrainingStop.EPOCH_LIMIT
    rng = np.random.default_rng(len(training.inputs))
    for _ in range(rules.epochs):
        order = rng.permutation(len(training.inputs))
        for batch in np.array_split(order, max(1, len(order) // BATCH)):
            part = Samples(
                inputs=training.inputs[batch], outputs=training.outputs[batch], weights=training.weights[batch]
            )
            gradient = flattened(error_gradient(unpack(theta), part))
            gradient *= min(1.0, LONGEST_GRADIENT / max(float(np.linalg.norm(gradient)), 1e-300))
            step = MOMENTUM * step - rate * gradient
            theta = theta + step
        training_rms.append(_rms(unpack(theta), training))
        validation_rms.append(_rms(unpack(theta), validation))
        if validation_rms[-1] < best:
            best, best_theta, stalled = validation_rms[-1], theta, 0
            continue
        stalled += 1
        if stalled == STALLED:
            rate, stalled = rate * SLOWER, 0
            if rate < LAST_RATE:
                stop = TrainingStop.VALIDATION
                break
    return Fit(layers=unpack(best_theta), training_rms=training_rms, validation_rms=validation_rms, stop=stop)


def _hyperparameters(gamma: float, values: int, squares: float, theta: np.ndarray) -> tuple[float, float]:
    """Return alpha and beta of [2]_ for gamma determined parameters."""
    return gamma / float(2 * theta @ theta), (values - gamma) / (2 * squares)


def _factor(matrix: np.ndarray, shift: float) -> tuple[np.ndarray, bool] | None:
    """Return the Cholesky factor of matrix + shift I, or None where rounding leaves it indefinite."""
    try:
        factor, lower = cho_factor(matrix + shift * np.eye(len(matrix)), overwrite_a=True, check_finite=False)
    except LinAlgError:
        return None
    return factor, lower


def _residual(outputs: np.ndarray, samples: Samples) -> np.ndarray:
    return samples.weights * (samples.outputs - outputs)


def _sum_of_squares(layers: Sequence[np.ndarray], samples: Samples) -> float:
    residual = _residual(forward(layers, samples.inputs)[-1], samples)
    return float(np.vdot(residual, residual))


def _rms(layers: Sequence[np.ndarray], samples: Samples) -> float:
    return math.sqrt(_sum_of_squares(layers, samples) / samples.outputs.size)


def error_gradient(layers: Sequence[np.ndarray], samples: Samples) -> list[np.ndarray]:
    """Return the gradient of the mean squared error by the layers, by backpropagation."""
    outputs = forward(layers, samples.inputs)
    residual = _residual(outputs[-1], samples)
    delta = -2 / residual.size * samples.weights * residual
    gradient = []
    for number in range(len(layers) - 1, -1, -1):
        fed = samples.inputs if number == 0 else outputs[number - 1]
        gradient.append(np.vstack([fed.T @ delta, delta.sum(axis=0)]))
        if number:
            delta = (delta @ layers[number][:-1].T) * (1 - fed**2)
    return gradient[::-1]
