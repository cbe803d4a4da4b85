"""The feedforward network that maps rays to the microlens array, Eqs. 6-7.

The network of one camera maps (x, y, z, u, v), an object point and a pupil point, to (s, t), the position on the
microlens array, all in mm. `lfpiv.calibration.training` fits it to labelled rays. `sigma_nor` is its error, Eq. 8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lfpiv.calibration.levenberg_marquardt import forward

CHUNK_POINTS = 1 << 16
"""Points evaluated at once. Bounds the memory of the hidden layers."""

_SCALING = ("input_centre", "input_scale", "output_centre", "output_scale")


@dataclass(frozen=True, kw_only=True, eq=False)
class Network:
    """A feedforward network with tanh hidden layers and a linear output layer, Eqs. 6-7.

    It can represent the paper's network of logistic sigmoids, because sigmoid(x) = (1 + tanh(x / 2)) / 2.
    """

    weights: tuple[np.ndarray, ...]
    """Weights of each layer, shape (inputs, nodes). The last layer is the output layer."""
    biases: tuple[np.ndarray, ...]
    """Biases of each layer, shape (nodes,)."""
    input_centre: np.ndarray
    """Input that the first layer sees as 0, shape (d,) [input unit]."""
    input_scale: np.ndarray
    """Input difference that the first layer sees as 1, shape (d,) [input unit]."""
    output_centre: np.ndarray
    """Output where the last layer gives 0, shape (m,) [output unit]."""
    output_scale: np.ndarray
    """Output difference where the last layer's value rises by 1, shape (m,) [output unit]."""

    def __post_init__(self) -> None:
        sizes = [self.input_centre.size, *(bias.size for bias in self.biases)]
        shapes = [weight.shape for weight in self.weights]
        if len(shapes) < 2 or shapes != list(pairwise(sizes)):
            raise ValueError(
                f"network: layers do not fit together: weights of shapes {shapes}, biases and inputs of sizes {sizes}; "
                "expected at least two layers, each with the shape (inputs, nodes)."
            )
        if self.input_scale.shape != (sizes[0],) or not (
            self.output_centre.shape == self.output_scale.shape == (sizes[-1],)
        ):
            raise ValueError(f"network: scaling does not fit {sizes[0]} inputs and {sizes[-1]} outputs.")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of inputs, of nodes of each hidden layer, and of outputs."""
        return (self.weights[0].shape[0], *(weight.shape[1] for weight in self.weights))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Evaluate the network, Eqs. 6-7, shape (n, m), float64.

        Parameters
        ----------
        points : array_like, shape (n, d)
            Inputs in their own unit.

        Raises
        ------
        ValueError
            If `points` does not have d columns.
        """
        points = np.asarray(points, float)
        if points.ndim != 2 or points.shape[1] != self.sizes[0]:
            raise ValueError(f"points: expected shape (n, {self.sizes[0]}), got {points.shape}.")
        layers, values = self.layers(), np.empty((len(points), self.sizes[-1]))
        for first in range(0, len(points), CHUNK_POINTS):
            part = slice(first, first + CHUNK_POINTS)
            scaled = (points[part] - self.input_centre) / self.input_scale
            values[part] = self.output_centre + self.output_scale * forward(layers, scaled)[-1]
        return values

    def layers(self) -> list[np.ndarray]:
        """Return each layer as one matrix (inputs + 1, nodes) with the biases in the last row."""
        return [np.vstack([weight, bias]) for weight, bias in zip(self.weights, self.biases, strict=True)]

    def of_affine_inputs(self, matrix: np.ndarray, shift: np.ndarray) -> Network:
        """Return the network whose value at x is this network's value at ``matrix x + shift``.

        The result is exact: the first layer takes up matrix and shift.

        Parameters
        ----------
        matrix : ndarray, shape (d, d)
        shift : ndarray, shape (d,)
            In the input's unit.
        """
        first = (matrix * self.input_scale / self.input_scale[:, None]).T @ self.weights[0]
        bias = (matrix @ self.input_centre + shift - self.input_centre) / self.input_scale @ self.weights[0]
        return replace(self, weights=(first, *self.weights[1:]), biases=(self.biases[0] + bias, *self.biases[1:]))

    def with_scaled_output(self, factor: float) -> Network:
        """Return the network with all outputs multiplied by a factor."""
        return replace(self, output_centre=factor * self.output_centre, output_scale=factor * self.output_scale)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the network as named arrays for files and kernels. `from_arrays` is the inverse."""
        arrays = {name: getattr(self, name) for name in _SCALING}
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight_{number}"], arrays[f"bias_{number}"] = weight, bias
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Network:
        """Build a network from the arrays of `to_arrays`. Ignore other keys.

        Raises
        ------
        ValueError
            If an array is missing or the shapes do not fit together.
        """
        count = sum(name.startswith("weight_") for name in arrays)
        names = (*_SCALING, *(f"{kind}_{number}" for kind in ("weight", "bias") for number in range(count)))
        missing = [name for name in names if name not in arrays]
        if missing or count == 0:
            raise ValueError(
                f"network: expected arrays as Network.to_arrays writes them; missing {missing or 'weight_0'}."
            )
        return cls(
            weights=tuple(np.array(arrays[f"weight_{number}"], float) for number in range(count)),
            biases=tuple(np.array(arrays[f"bias_{number}"], float) for number in range(count)),
            **{name: np.array(arrays[name], float) for name in _SCALING},
        )


def sigma_nor(predicted: np.ndarray, truth: np.ndarray, pitch: float) -> float:
    """Return the mean distance between predicted and true positions in microlens pitches, Eq. 8.

    Parameters
    ----------
    predicted, truth : array_like, shape (n, 2)
        Positions (s, t) on the microlens array [mm].
    pitch : float
        Microlens pitch [mm].
    """
    return float(np.linalg.norm(np.asarray(predicted, float) - np.asarray(truth, float), axis=1).mean() / pitch)
